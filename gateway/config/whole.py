"""A file that needs no other one: for a machine that has neither its templates nor its sheets."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gateway.config.loading import dumped, load, with_sheets
from gateway.config.yaml.file import TEXTS, read_yaml
from gateway.config.yaml.syntax import DEEPEST
from gateway.errors import ConfigError


def whole_text(path: Path) -> str:
    """Returns the text of a file, with the templates and sheets of other files in it. A file that
    names none is as it is, with its comments. Raises `ConfigErrors`."""
    file, mistakes = read_yaml(path, TEXTS)
    mistakes.raise_all()
    if "templates_from" not in file.data and "tags_from" not in file.text:
        return file.text
    config = load(path, elsewhere=True)  # all mistakes of the other files
    data = dict(file.data)
    names = data.pop("templates_from", [])
    templates: dict[str, Any] = {}
    for name in [names] if isinstance(names, str) else names:
        templates |= read_yaml(path.parent / name, TEXTS)[0].data.get("templates", {})
    if templates:
        data["templates"] = templates | data.get("templates", {})
    for sheet in config.sheets:
        if not _names_a_sheet(data, sheet.device):
            raise ConfigError(
                f"{path}: {sheet.device} has {sheet.file.name} from a template or by `repeat`: its "
                "tags go into no other file; write `tags_from` at a device of this name"
            )
    return dumped(with_sheets(data, {sheet.device: sheet.raw for sheet in config.sheets}))


def _names_a_sheet(data: Mapping[str, Any], device: str) -> bool:
    """Returns False for a device of a template, or of a `repeat`."""
    found = (line["devices"].get(device) for line in data["lines"].values())
    return any(isinstance(one, dict) and "tags_from" in one for one in found)


def patched_text(path: Path, patch: Mapping[str, Any]) -> str:
    """Returns the text of a file with other settings, and without its comments. `patch`: the
    settings below their sections; null removes one (RFC 7396). Raises `ConfigErrors`."""
    file, mistakes = read_yaml(path, TEXTS)
    mistakes.raise_all()
    return dumped(_merged(file.data, patch, DEEPEST))


def _merged(data: Any, patch: Any, levels: int) -> Any:
    if not isinstance(patch, Mapping):
        return patch
    if not levels:
        raise ConfigError(f"the patch has more than {DEEPEST} levels")
    found = dict(data) if isinstance(data, dict) else {}
    for name, value in patch.items():
        if value is None:
            found.pop(name, None)
        else:
            found[name] = _merged(found.get(name), value, levels - 1)
    return found
