"""The configuration: one YAML file, checked as a whole, every mistake named with its line."""

import gc
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from gateway.config.build import Builder
from gateway.config.file_rules import check_files
from gateway.config.messages import ConfigErrors, Mistakes, OptionPlaces
from gateway.config.records import (
    Config,
    HistoryConfig,
    LineConfig,
    TlsConfig,
    WebConfig,
    ZenohConfig,
    ZenohMode,
)
from gateway.config.schema import schema
from gateway.config.sheet_tags import SheetUse
from gateway.config.yaml_file import read_yaml

__all__ = [
    "Config",
    "ConfigErrors",
    "HistoryConfig",
    "LineConfig",
    "TlsConfig",
    "WebConfig",
    "SheetUse",
    "ZenohConfig",
    "ZenohMode",
    "built",
    "load",
    "schema",
]

# Settings that are texts even where YAML sees a number: `7E1`, `40101`, `unit: 1`.
_TEXTS = frozenset({"address", "description", "format", "name", "port", "prefix", "unit"})


def load(
    path: str | Path,
    report: Callable[[str, float], None] | None = None,
    imports: Mapping[str, Path] | None = None,
) -> Config:
    """Reads and checks the file. Paths in it are relative to its folder.

    `report` receives the name of each step and the share of it that is done. `imports`: a sheet
    with more tags, by device. Raises `ConfigErrors` with every mistake.
    """
    read = None if report is None else partial(report, f"reading {Path(path).name}")
    checked = None if report is None else partial(report, "checking the tags")
    with _without_gc():
        file, mistakes = read_yaml(Path(path), _TEXTS, read)
        config = Builder(mistakes, Path(path).parent, checked, imports or {}).config(file.data)
        if config is not None:
            check_files(config, Path(path), mistakes)
    mistakes.raise_all()
    if config is None:
        raise AssertionError(f"{path}: no configuration, and no mistake either")
    return config


def built(data: Mapping[str, object], folder: Path | None = None) -> Config:
    """Returns the configuration of data that is in no file. Raises `ConfigErrors`."""
    mistakes = Mistakes(OptionPlaces())
    config = Builder(mistakes, folder or Path()).config(data)
    mistakes.raise_all()
    if config is None:
        raise AssertionError(f"{data}: no configuration, and no mistake either")
    return config


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
