"""A rollout: each gateway loads its file, is watched, and keeps the file only while it is well."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from enum import StrEnum
from typing import NamedTuple

from gateway.cli.client import Client
from gateway.cli.fleet.health import Health, read_remote
from gateway.contract.documents.fleet import RemoteDocument
from gateway.errors import GatewayError

KEY = "remote/file"
RESERVE = 5.0  # seconds before a file goes back in which it is no longer confirmed
LOADING = 50.0  # seconds that a large gateway may take longer to load a file
LOOK_EVERY = 10.0  # seconds
_AGAIN = 1.0  # seconds after a look that found no answer, or devices that are not up yet


class Result(StrEnum):
    """Of one gateway."""

    SAME = "same"
    GOOD = "good"
    CONFIRMED = "confirmed"
    UNREACHABLE = "unreachable"
    REFUSED = "refused"
    WORSE = "worse"
    LOST = "lost"
    BACK = "back"
    LEFT = "left"


DONE = (Result.SAME, Result.GOOD, Result.CONFIRMED)
_STOPS = (Result.REFUSED, Result.WORSE, Result.LOST)


class Ended(NamedTuple):
    """The end of one gateway: prefix and name, the result, and a sentence or nothing."""

    gateway: str
    result: Result
    says: str = ""


class Step(NamedTuple):
    """The order for one gateway, and the digest of the file that it then runs."""

    order: Mapping[str, object]
    digest: str


class Pace(NamedTuple):
    """`wait`, `look`: seconds for which canaries and all others are watched; `within`: then an
    unconfirmed file goes back."""

    canary: int
    wait: float
    look: float
    within: float
    parallel: int


class Rollout:
    """Canaries first, the others after them. The first gateway that is not well ends it: its file,
    and each that is not confirmed yet, goes back at once. No state but that of the gateways."""

    def __init__(
        self, client: Client, steps: Mapping[str, Step], tell: Callable[[Ended], None]
    ) -> None:
        self._client, self._steps, self._tell = client, steps, tell
        self._stop = threading.Event()
        self._why = ""  # it stopped
        self._turn = threading.Lock()

    def run(self, pace: Pace) -> list[Ended]:
        """Returns the end of each gateway. Ctrl-C stops it."""
        names = [*self._steps]
        found = self._each(names[: pace.canary], pace.wait, pace)
        if not any(one.result is Result.CONFIRMED for one in found) and pace.canary and found:
            self._halt("no canary has confirmed its file")
        return found + self._each(names[pace.canary :], pace.look, pace)

    def check(self, parallel: int) -> list[Ended]:
        """Has each gateway check its file."""
        return self._all([*self._steps], self._checked, parallel)

    def _each(self, names: Sequence[str], look: float, pace: Pace) -> list[Ended]:
        return self._all(names, lambda name: self._one(name, look, pace.within), pace.parallel)

    def _all(
        self, names: Sequence[str], work: Callable[[str], Ended], parallel: int
    ) -> list[Ended]:
        with ThreadPoolExecutor(parallel) as pool:
            ends = [pool.submit(self._told, work, name) for name in names]
            try:
                return [end.result() for end in ends]
            except KeyboardInterrupt:
                self._halt("it was ended by Ctrl-C")
                return [end.result() for end in ends]

    def _told(self, work: Callable[[str], Ended], name: str) -> Ended:
        ended = work(name)
        with self._turn:
            self._tell(ended)
        return ended

    def _halt(self, why: str) -> None:
        with self._turn:
            self._why = self._why or why
            self._stop.set()

    def _checked(self, name: str) -> Ended:
        try:
            answer = self._client.of(name).requests.order(KEY, self._steps[name].order, LOADING)
        except GatewayError as error:
            return Ended(name, Result.UNREACHABLE, str(error))
        if "error" in answer:
            return Ended(name, Result.REFUSED, str(answer["reason"]))
        return Ended(name, Result.GOOD)

    def _one(self, name: str, look: float, within: float) -> Ended:
        if self._stop.is_set():
            return Ended(name, Result.LEFT, self._why)
        ended = self._changed(name, look, within)
        if ended.result in _STOPS:
            self._halt(f"{name}: {ended.result}")
        return ended

    def _changed(self, name: str, look: float, within: float) -> Ended:
        one, step = self._client.of(name), self._steps[name]
        try:
            before = self._before(one, look)
        except GatewayError as error:
            return Ended(name, Result.UNREACHABLE, str(error))
        began = time.monotonic()
        until = began + look + within - RESERVE
        change = self._loaded(one, step, look + within, until)
        if isinstance(change, tuple):
            return Ended(name, *change)
        wrong = self._watched(one, before, began + look, until)
        if wrong is None:
            why = f"no answer since it loaded the file: it goes back by itself at {change['until']}"
            return Ended(name, Result.LOST, why)
        if not wrong and not self._stop.is_set():
            return Ended(name, *self._confirmed(one, step.digest, until))
        end = self._sent(one, {"do": "revert"}, until)
        is_back = end is not None and end["state"] == "reverted"
        back = "it went back" if is_back else f"it goes back by itself at {change['until']}"
        if wrong:
            return Ended(name, Result.WORSE, f"{'; '.join(wrong)}: {back}")
        return Ended(name, Result.BACK, f"{back}: {self._why}")

    def _before(self, one: Client, within: float) -> Health:
        """Asks until no device is starting, `within` so many seconds. Raises `GatewayError`.

        A device that is starting may have been up before the gateway was started.
        """
        until = time.monotonic() + within
        while True:
            before = Health.of(one)
            if not before.starting or time.monotonic() >= until or self._stop.wait(_AGAIN):
                return before

    def _loaded(
        self, one: Client, step: Step, confirm: float, until: float
    ) -> RemoteDocument | tuple[Result, str]:
        """Returns the change that waits, or why none does."""
        try:
            answer = one.requests.order(KEY, {**step.order, "confirm": confirm}, LOADING)
            if "error" in answer:
                return Result.REFUSED, str(answer["reason"])
            return read_remote(answer)
        except GatewayError as error:  # it may have loaded the file
            while (change := self._state(one)) is None and time.monotonic() < until:
                time.sleep(_AGAIN)
            if change is not None and change["state"] == "waiting":
                return change
            return Result.LOST, f"{error}; if it loaded the file, it goes back by itself"

    def _confirmed(self, one: Client, digest: str, until: float) -> tuple[Result, str]:
        end = self._sent(one, {"do": "confirm", "digest": digest}, until)
        if end is None:
            return Result.LOST, "no answer to the confirmation: it goes back by itself, or has it"
        if end["state"] != "confirmed":
            return Result.WORSE, f"it went back: {end['why']}"
        return Result.CONFIRMED, ""

    def _watched(
        self, one: Client, before: Health, ends: float, until: float
    ) -> Sequence[str] | None:
        """Returns what is worse than before, twice in a row or at the end; None: no answer. Devices
        that were up have until `until` to be up again."""
        worse: Sequence[str] = ()
        while True:
            left = ends - time.monotonic()
            if self._stop.wait(min(LOOK_EVERY, left) if left > 0 else _AGAIN):
                return ()
            now, last, worse = None, worse, ()
            with suppress(GatewayError):
                now = Health.of(one)
                worse = now.worse_than(before)
            is_over = time.monotonic() >= ends
            if worse and (last or is_over):
                return worse
            missing = None if now is None else now.not_up_again(before)
            if is_over and missing == []:
                return ()
            if time.monotonic() >= until:
                return missing

    def _sent(
        self, one: Client, order: Mapping[str, object], until: float
    ) -> RemoteDocument | None:
        """Sends an end until the file no longer waits. Returns the last change; None: it is not
        known."""
        while True:
            with suppress(GatewayError):
                one.requests.order(KEY, order)
            change = self._state(one)
            if change is not None and change["state"] != "waiting":
                return change
            if time.monotonic() >= until:
                return None
            time.sleep(_AGAIN)

    @staticmethod
    def _state(one: Client) -> RemoteDocument | None:
        with suppress(GatewayError):
            return read_remote(one.status(KEY))
        return None
