"""The configuration: one YAML file, checked as a whole, every mistake named with its line."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gateway.config.json_schema import schema
    from gateway.config.loading import built, expanded_text, load, state_folder
    from gateway.config.messages import ConfigErrors
    from gateway.config.settings.records import Config, LineConfig
    from gateway.config.settings.zenoh_records import TlsConfig, ZenohConfig, ZenohMode
    from gateway.config.sheets.tags import SheetUse
else:
    # Each is imported when it is used: a client of a running gateway needs few of them.
    _MODULES = {
        "json_schema": ("schema",),
        "loading": ("built", "expanded_text", "load", "state_folder"),
        "messages": ("ConfigErrors",),
        "settings.records": ("Config", "LineConfig"),
        "sheets.tags": ("SheetUse",),
        "settings.zenoh_records": ("TlsConfig", "ZenohConfig", "ZenohMode"),
    }
    _PLACES = {name: module for module, names in _MODULES.items() for name in names}

    def __getattr__(name: str) -> object:
        if name not in _PLACES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        found = globals()[name] = getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
        return found
