"""Data as a YAML file that is read as the same data."""

from collections.abc import Mapping
from typing import Any

import yaml

from gateway.config.yaml.scalars import scalar


class _Dumper(yaml.SafeDumper):
    """Writes a text in quotes where the file would not be read as this text."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    is_text = text.isprintable() and text != "" and isinstance(scalar(text), str)
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=None if is_text else '"')


_Dumper.add_representer(str, _text)


def dumped(data: Mapping[str, Any]) -> str:
    """Returns the text; the innermost settings are on one line."""
    return yaml.dump(
        dict(data),
        Dumper=_Dumper,
        sort_keys=False,
        allow_unicode=True,
        default_flow_style=None,
        width=10_000,  # a tag is one line
    )
