"""Health of one gateway before and after another file, from its own short documents."""

from collections.abc import Mapping
from typing import NamedTuple, TypeVar

from pydantic import TypeAdapter
from typing_extensions import TypedDict

from gateway.cli.client import Client
from gateway.contract.documents.fleet import RemoteDocument, ReportDocument
from gateway.contract.documents.state import Standing
from gateway.errors import GatewayError

T = TypeVar("T")


class _Standings(TypedDict):
    devices: dict[str, Standing]


_REPORT, _STATUS = TypeAdapter(ReportDocument), TypeAdapter(_Standings)
_REMOTE = TypeAdapter(RemoteDocument)


class Health(NamedTuple):
    """Faults by code, the sentence of the first, and the standing of each device."""

    faults: Mapping[str, int]
    fault: str
    devices: Mapping[str, str]

    @classmethod
    def of(cls, one: Client) -> "Health":
        """Asks a gateway. Raises `GatewayError`."""
        report = _read(_REPORT, one.status("report"))
        return cls(report["faults"], report["fault"], _read(_STATUS, one.status())["devices"])

    @property
    def starting(self) -> bool:
        """Returns True while it is not known of a device if it replies."""
        return "starting" in self.devices.values()

    def worse_than(self, before: "Health") -> list[str]:
        """Returns a sentence for each device that is newly silent, and for each kind of fault that
        is new or grew."""
        silent = [
            f"{name} is silent, and was {before.devices.get(name, 'not there')}"
            for name, standing in self.devices.items()
            if standing == "silent" != before.devices.get(name)
        ]
        grown = [
            f"{number} {code}, before {before.faults.get(code, 0)}: {self.fault}"
            for code, number in self.faults.items()
            if number > before.faults.get(code, 0)
        ]
        return silent + grown

    def not_up_again(self, before: "Health") -> list[str]:
        """Returns a sentence for each device that was up and has not answered yet."""
        return [
            f"{name} is {standing}, and was up"
            for name, standing in self.devices.items()
            if standing != "up" == before.devices.get(name)
        ]


def read_remote(document: Mapping[str, object]) -> RemoteDocument:
    """Raises `GatewayError`."""
    return _read(_REMOTE, document)


def _read(adapter: TypeAdapter[T], document: Mapping[str, object]) -> T:
    try:
        return adapter.validate_python(document)
    except ValueError as error:
        what = " ".join(str(error).splitlines()[1:3])
        raise GatewayError(f"its answer cannot be read: {what}") from None
