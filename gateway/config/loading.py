"""Loads the file: reads it, expands its templates, checks it as a whole, and the files it names."""

import gc
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from pathlib import Path as FilePath
from typing import Any

import yaml

from gateway import files
from gateway.config.build import Builder
from gateway.config.messages import Mistakes, OptionPlaces
from gateway.config.settings.records import Config
from gateway.config.settings.sections import Written, reads, writes
from gateway.config.share import folder_of, share_of
from gateway.config.sheets import Grid
from gateway.config.templates.expand import devices_in, expanded
from gateway.config.yaml.file import TEXTS, read_yaml
from gateway.config.yaml.scalars import scalar

_DIGITS = 16  # of a digest
STATE_VARIABLE = "STATE_DIRECTORY"  # systemd sets it, with one or more folders


def load(
    path: str | Path,
    report: Callable[[str, float], None] | None = None,
    imports: Mapping[str, tuple[Path, Grid]] | None = None,
    text: str | None = None,
    *,
    elsewhere: bool = False,
    share: tuple[int, int] | None = None,
) -> Config:
    """Reads and checks the file. Paths in it are relative to its folder; those of files that the
    gateway writes are relative to `state_folder()`, if there is one.

    `report` receives the name of each step and the share of it that is done. `imports`: a sheet
    with more tags, by device. `text`: what the file is going to have.
    `elsewhere`: it is for another machine; secrets and certificates that it names are there.
    `share`: returns this share of the file (`config.share`).
    Raises `ConfigErrors` with every mistake, and `ConfigError` for a file that has no shares.
    """
    read = None if report is None else partial(report, f"reading {Path(path).name}")
    checked = None if report is None else partial(report, "checking the tags")
    with _without_gc():
        file, mistakes = read_yaml(Path(path), TEXTS, read, text)
        mistakes.elsewhere = elsewhere
        folder = Path(path).parent
        kept = state_folder() if share is None else folder_of(share, state_folder() or folder)
        builder = Builder(mistakes, folder, kept, checked, imports or {})
        data = expanded(file, mistakes, Path(path).parent)
        config = builder.config(data)
        if config is not None:
            check_files(config, Path(path), mistakes)
            config = replace(config, digest=digest(data, config))
    mistakes.raise_all()
    if config is None:
        raise AssertionError(f"{path}: no configuration, and no mistake either")
    return config if share is None else share_of(config, share)


def digest(data: Mapping[str, Any], config: Config) -> str:
    """Returns a digest of all settings of a file, of its templates and its sheets, without comments
    and layout: files of one digest make gateways that do the same."""
    sheets = {sheet.device: sheet.raw for sheet in config.sheets}
    packed = json.dumps(with_sheets(data, sheets) if sheets else data, default=str)
    return hashlib.sha256(packed.encode()).hexdigest()[:_DIGITS]


def with_sheets(data: Mapping[str, Any], sheets: Mapping[str, Mapping[str, object]]) -> Any:
    """Returns the data as if the tags of the sheets were in the file itself."""
    lines = {}
    for line, raw in data["lines"].items():
        devices = dict(raw["devices"])
        for name in devices.keys() & sheets.keys():
            own = {key: value for key, value in devices[name].items() if key != "tags_from"}
            tags = own.pop("tags", None) or {}
            devices[name] = {**own, "tags": {**tags, **sheets[name]}}
        lines[line] = {**raw, "devices": devices}
    return {**data, "lines": lines}


def expanded_text(path: str | Path) -> str:
    """Returns the file with every template expanded, as a file that has none. Raises
    `ConfigErrors`."""
    file, mistakes = read_yaml(Path(path), TEXTS)
    data = expanded(file, mistakes, Path(path).parent)
    mistakes.raise_all()
    for device in devices_in(data):
        device.pop("use", None)
    return dumped(data)


def built(
    data: Mapping[str, object],
    folder: Path | None = None,
    imports: Mapping[str, tuple[Path, Grid]] | None = None,
) -> Config:
    """Returns the configuration of data that is in no file. `imports`: as in `load`.

    Raises `ConfigErrors`.
    """
    mistakes = Mistakes(OptionPlaces())
    config = Builder(mistakes, folder or Path(), imports=imports or {}).config(data)
    mistakes.raise_all()
    if config is None:
        raise AssertionError(f"{data}: no configuration, and no mistake either")
    return config


def state_folder() -> Path | None:
    """Returns the folder for the files that the gateway writes: systemd's StateDirectory, or that
    of a container. None: beside the configuration file."""
    first = os.environ.get(STATE_VARIABLE, "").partition(":")[0]
    return Path(first) if first else None


@contextmanager
def _without_gc() -> Iterator[None]:
    """Disables the garbage collector: walking the growing tree again and again takes two thirds
    of the time of a large file, and finds no garbage in it."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


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


_STATE = ("", ".new", ".bad")
_AUDIT = ("", *(f".{number}" for number in range(1, 10)))


def check_files(config: Config, own: FilePath, mistakes: Mistakes) -> None:
    """`own`: the configuration file."""
    earlier: list[tuple[str, FilePath]] = []
    for one in written(config):
        for what, other in (*_read(config, own), *earlier):
            if not mistakes.has(one.setting) and any(
                files.are_same(FilePath(f"{one.file}{tail}"), other) for tail in one.tails
            ):
                mistakes.at(*one.setting).add(
                    f"{one.file.name} is {what}: name another file, such as {one.example}"
                )
        what = f"a file of {'.'.join(map(str, one.setting))}"
        earlier += [(what, FilePath(f"{one.file}{tail}")) for tail in one.tails]


def written(config: Config) -> Iterator[Written]:
    """Yields the files that the gateway writes."""
    yield from writes(config.parts)
    if config.state_file is not None:
        yield Written(("gateway", "state"), config.state_file, _STATE, "state.json")
    if config.held_file is not None and any(line.serve for line in config.lines):
        yield Written(("gateway", "state"), config.held_file, _STATE, "state.json")
    if config.audit_file is not None:
        yield Written(("gateway", "audit"), config.audit_file, _AUDIT, "audit.jsonl")
    if config.writers_state is not None:
        yield Written(("writers", "file"), config.writers_state, _STATE, "writers.txt")


def _read(config: Config, own: FilePath) -> Iterator[tuple[str, FilePath]]:
    zenoh = config.zenoh
    read = {
        "the configuration file": own,
        "zenoh.config_file": zenoh.config_file,
        "zenoh.password_file": zenoh.password_file,
        "zenoh.users_file": zenoh.users_file,
        "writers.file": config.writers_file,
        "gateway.secret_file": config.secret_file,
        **dict(reads(config.parts)),
    }
    for name, tls in config.secured.items():
        read |= {f"{name}.ca": tls.ca, f"{name}.key": tls.key}
        read |= {f"{name}.certificate": tls.certificate, f"{name}.revoked": tls.revoked}
    yield from ((what, file) for what, file in read.items() if file is not None)
    yield from (("a sheet of tags", sheet.file) for sheet in config.sheets)
