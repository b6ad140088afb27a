"""Rows of many gateways: one for each, the worst first, with the sentence that a person needs."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import IntEnum

from pydantic import TypeAdapter

from gateway.contract.documents.fleet import ReportDocument
from gateway.contract.faults import DAYS_LEFT, DAYS_OF_DISK
from gateway.contract.fleet_files import Wanted

LARGEST_OFFSET = 5.0  # seconds between a clock and that of this computer
_REPORT = TypeAdapter(ReportDocument)


class State(IntEnum):
    """Of a gateway; the smallest is the worst."""

    MISSING = 0
    FAULT = 1
    LOOK = 2
    GOOD = 3


@dataclass(frozen=True, slots=True)
class Told:
    """The report of a gateway. `offset`: seconds that its clock is ahead of this computer's, beyond
    the time of the query. `is_twin`: another gateway has the same name."""

    report: ReportDocument
    offset: float
    is_twin: bool = False


@dataclass(frozen=True, slots=True)
class Row:
    """One gateway. `gateway`: its prefix and name; `drift`: how its file differs from the folder;
    `says`: one sentence, empty when all is well."""

    gateway: str
    state: State
    told: Told | None
    drift: str
    says: str

    def document(self) -> dict[str, object]:
        report = {} if self.told is None else dict(self.told.report)
        offset = None if self.told is None else round(self.told.offset, 3)
        return {
            "gateway": self.gateway,
            "state": self.state.name.lower(),
            "says": self.says,
            "drift": self.drift,
            "clock_offset": offset,
            **report,
        }


def rows(
    told: Mapping[str, Told], wanted: Mapping[str, Wanted] | None, seen: Mapping[str, str]
) -> list[Row]:
    """Returns a row for each gateway that replied, that has a file, or that was `seen` earlier
    (when), the worst first. `wanted` None: there is no folder to compare with."""
    newest = max((_version(one.report) for one in told.values()), default=())
    found = [
        _row(gateway, told.get(gateway), wanted, seen.get(gateway), newest)
        for gateway in {**told, **(wanted or {}), **seen}
    ]
    return sorted(found, key=lambda row: (row.state, row.gateway))


def _row(
    gateway: str,
    told: Told | None,
    wanted: Mapping[str, Wanted] | None,
    seen: str | None,
    newest: tuple[int, ...],
) -> Row:
    drift = "" if wanted is None or told is None else _drift(told.report, wanted.get(gateway))
    if told is None:
        when = f"silent since {seen[:19]}Z" if seen else "it never replied"
        return Row(gateway, State.MISSING, None, "", when)
    if told.report["fault"]:
        more = sum(told.report["faults"].values()) - 1
        fault = f"{told.report['fault']}{f', and {more} more' if more else ''}"
        return Row(gateway, State.FAULT, told, drift, "; ".join([fault, *_differs(drift)]))
    says = "; ".join(_to_look_at(told, drift, newest))
    return Row(gateway, State.LOOK if says else State.GOOD, told, drift, says)


def _drift(report: ReportDocument, wanted: Wanted | None) -> str:
    if wanted is None:
        return "no file"
    return "" if wanted.digest == report["digest"] else f"differs from {wanted.file.name}"


def _differs(drift: str) -> Iterator[str]:
    if drift:
        yield "no file of the folder is its own" if drift == "no file" else f"its file {drift}"


def _to_look_at(told: Told, drift: str, newest: tuple[int, ...]) -> Iterator[str]:
    report = told.report
    if report["refused"]:
        yield f"its changed file was refused: {report['refused_why']}"
    yield from _differs(drift)
    if abs(told.offset) > LARGEST_OFFSET:
        yield f"its clock is {told.offset:+.0f} s off"
    if (days := report["certificate_days"]) is not None and days < DAYS_LEFT:
        yield f"a certificate ends in {days:.0f} days"
    if (days := report["disk_days"]) is not None and days < DAYS_OF_DISK:
        yield f"its disk is full in {days:.0f} days"
    if _version(report) < newest:
        yield f"version {report['version']} is old"
    if report["warnings"]:
        yield f"{report['warnings']} warnings: see its `status`"


def _version(report: ReportDocument) -> tuple[int, ...]:
    return tuple(
        int(one[:9]) for one in report["version"].split("+")[0].split(".") if one.isdecimal()
    )


def told_by(
    replies: Iterable[tuple[str, bytes, float]], asked: float
) -> tuple[dict[str, Told], list[str]]:
    """Returns the reports by gateway, from key, payload and arrival (s since 1970) of each reply,
    and what is wrong with them. `asked`: when the query began."""
    found, mistakes = dict[str, Told](), list[str]()
    for key, payload, arrived in replies:
        gateway = gateway_of(key, "report")
        try:
            report = _REPORT.validate_json(payload)
            at = datetime.fromisoformat(report["time"]).timestamp()
        except ValueError as error:  # and pydantic's, which is one
            what = str(error).splitlines()
            mistakes.append(f"{gateway}: its report cannot be read: {' '.join(what[1:3]) or what}")
            continue
        if is_twin := gateway in found:
            mistakes.append(f"two gateways are called {gateway}: give each its own `gateway.name`")
        found[gateway] = Told(report, max(0.0, at - arrived) + min(0.0, at - asked), is_twin)
    return found, mistakes


def gateway_of(key: str, path: str) -> str:
    """Returns prefix and name of a gateway from the key of one of its documents."""
    return key.replace("/@gateway/", "/").removesuffix(f"/{path}")
