"""A rollout begins with what a gateway knows of its devices, not while it is starting them."""

from typing import Any

import pytest

from gateway.cli.fleet import rollout
from gateway.cli.fleet.health import Health
from gateway.cli.fleet.rollout import Rollout, Step


class Gateway:
    """Its devices are starting at first. It takes a file, and one device is silent then."""

    def __init__(self, *standings: str) -> None:
        self.standings = list(standings)
        self.orders: list[dict[str, Any]] = []

    # The client

    def of(self, name: str) -> "Gateway":
        return self

    @property
    def requests(self) -> "Gateway":
        return self

    def order(self, key: str, order: dict[str, Any], within: float = 0.0) -> dict[str, Any]:
        self.orders.append(order)
        return self.status(key)

    def status(self, key: str = "") -> dict[str, Any]:
        if key == rollout.KEY:
            state = {"revert": "reverted", "confirm": "confirmed"}.get(
                self.orders[-1].get("do", ""), "waiting"
            )
            return {"state": state, "until": "soon", "why": ""}
        return {}

    def health(self) -> Health:
        silent = "silent" if self.orders else self.standings[0]
        if not self.orders and len(self.standings) > 1:
            del self.standings[0]
        return Health({}, "", {"pump": silent})


@pytest.mark.parametrize(
    ("standings", "result", "says"),
    [
        (("starting", "starting", "up"), "worse", "pump is silent, and was up: it went back"),
        (("silent",), "confirmed", ""),
    ],
)
def test_a_file_that_silences_a_device_is_noticed_although_it_was_starting(
    monkeypatch: pytest.MonkeyPatch, standings: tuple[str, ...], result: str, says: str
) -> None:
    gateway = Gateway(*standings)
    monkeypatch.setattr(Health, "of", classmethod(lambda cls, one: one.health()))
    monkeypatch.setattr(rollout, "read_remote", lambda document: document)
    monkeypatch.setattr(rollout, "_AGAIN", 0.0)
    monkeypatch.setattr(rollout, "LOOK_EVERY", 0.0)
    found: list[Any] = []
    steps = {"works/a": Step({"do": "load"}, "digest")}
    run = Rollout(gateway, steps, found.append)  # type: ignore[arg-type]
    [end] = run._each([*steps], 0.2, rollout.Pace(1, 0.2, 0.2, 8.0, 1))
    assert (end.result, end.says) == (result, says)
