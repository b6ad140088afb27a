"""Reads only the part of the file that a client needs to reach its gateway."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import ValidationError

from gateway.config.messages import ConfigErrors, Mistakes, OptionPlaces
from gateway.config.session_files import zenoh_config
from gateway.config.session_model import GatewaySection, ZenohSection
from gateway.config.yaml_events import first_sections
from gateway.config.yaml_file import TEXTS, file_text
from gateway.config.zenoh_records import ZenohConfig

if TYPE_CHECKING:
    from gateway.engine.device_settings import DeviceSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class Address:
    """The gateway of a file: its name and its Zenoh session. A `Config` without devices."""

    name: str
    standby: str | None
    zenoh: ZenohConfig
    devices: "tuple[DeviceSettings, ...]" = ()

    @property
    def dialling(self) -> Mapping[str, float]:
        """As in `Config`."""
        return {}


def address(path: Path) -> Address | None:
    """Returns the address of the gateway, without a check of the rest of the file.

    None where the two sections have a mistake, or cannot be read without the rest: `load` then
    says what is wrong, with its place.
    """
    mistakes = Mistakes(OptionPlaces())
    try:
        data = first_sections(file_text(path).encode(), TEXTS, ("gateway", "zenoh"))
        if data is None:
            return None
        gateway = GatewaySection.model_validate(data.get("gateway", {}))
        zenoh = ZenohSection.model_validate(data.get("zenoh", {}))
    except (ConfigErrors, ValidationError):
        return None
    settings = zenoh_config(zenoh, path.parent, mistakes)
    if len(mistakes):
        return None
    return Address(name=gateway.name, standby=gateway.standby, zenoh=settings)
