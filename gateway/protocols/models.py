"""Recognizes devices of one model: they differ in the station number only."""

from collections.abc import Hashable
from dataclasses import dataclass, field, fields, is_dataclass

from gateway.protocols.driver import Addressing


@dataclass(frozen=True, slots=True)
class Model:
    """The areas, addresses and costs that several drivers share. Equal for drivers that do."""

    key: Hashable
    driver: Addressing = field(compare=False, repr=False)  # one of them
    _hash: int = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_hash", hash(self.key))

    def __hash__(self) -> int:
        return self._hash


def model_of(driver: Addressing) -> Model:
    """Returns the model of a driver: its settings without the station number, and its areas.

    The number may decide which areas can be read: no station answers a broadcast.
    """
    key: Hashable = None
    if is_dataclass(driver):
        named = (one.name for one in fields(driver) if one.init and one.name != "station")
        settings = tuple((name, getattr(driver, name)) for name in named)
        key = (type(driver), settings, tuple(driver.areas.values()))
    try:
        hash(key)
    except TypeError:  # a mapping among the settings: no other driver is alike
        key = None
    return Model(id(driver) if key is None else key, driver)
