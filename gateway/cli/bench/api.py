"""The requests of the page: each does one step, and answers with a sentence if it cannot."""

import hmac
import json
import secrets
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from aiohttp import web

from gateway.cli.bench.draft import Draft
from gateway.cli.bench.line import SIMULATED, Registers, Scan, values
from gateway.cli.bench.running import Running
from gateway.cli.bench.trial import CONFIRM_WITHIN, Trial
from gateway.cli.client.arguments import parse_value
from gateway.cli.config.new import serial_ports
from gateway.cli.line.scan import protocols
from gateway.config.sheets.tags import other_settings
from gateway.errors import ConfigError, GatewayError
from gateway.parts.web.routes import Route, answer, as_json, body
from gateway.plant.threads import off_loop

_MOST_VALUES = 500
_SETTINGS = (  # that a column of a sheet may have, the usual ones first
    *("name", "address", "type", "unit", "scale", "offset", "every", "description", "min"),
    *("max", "write", "device", "deadband", "word_order", "history", "enum"),
)
Step = Callable[[Mapping[str, Any]], Awaitable[object]]


def _secret() -> str:
    return secrets.token_urlsafe(18)


class Entry:
    """The way in: an address that works once, then a token in the headers. As `Tokens`.

    Who enters last has the bench: the page before is out.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        """`tell` gets each new key: the first one, and one whenever a key was used."""
        self._tell = tell
        self._key, self._token = _secret(), _secret()

    def current(self) -> Mapping[str, bytes]:
        return {"bench": self._token.encode()}

    def begin(self) -> None:
        self._tell(self._key)

    async def enter(self, request: web.Request) -> web.Response:
        """Answers a key with a token."""
        sent = (await body(request))[:200]
        if not hmac.compare_digest(sent, self._key.encode()):
            return answer(403, "this address was used already: the terminal has a new one")
        self._key, self._token = _secret(), _secret()
        self._tell(self._key)
        return web.json_response({"token": self._token})


class BenchApi:
    """One file, and the page of it."""

    def __init__(self, path: Path, listen: str, within: float = CONFIRM_WITHIN) -> None:
        """`listen`: the endpoint of Zenoh in a new file."""
        self.draft = Draft(path)
        self.running = Running(path)
        self.scan = Scan()
        self.registers = Registers(self.running)
        self.trial = Trial(self.draft, self.running, within, self._release)
        self._listen = listen
        self._sheet = "", b""

    def routes(self, entry: Entry) -> list[Route]:
        steps: dict[str, Step] = {
            "scan": self._scan,
            "scan/stop": lambda _: self.scan.stop(),
            "stations": self._stations,
            "look": self._look,
            "tags": self._tags,
            "columns": self._columns,
            "import": self._import,
            "undo": lambda _: off_loop(self.draft.back),
            "reread": lambda _: off_loop(self.draft.read),
            "apply": lambda _: self._looking_on(self.trial.apply),
            "keep": lambda _: self.trial.keep(),
            "back": lambda _: self._looking_on(self.trial.back),
            "write": self._write,
        }
        return [
            Route("/api/enter", entry.enter, method="post", is_open=True),
            Route("/api/state", _answered(self._state)),
            Route("/api/registers", _answered(self._registers)),
            Route("/api/values", _answered(self._values)),
            Route("/api/sheet", _answered(self._take_sheet), method="post"),
            *(
                Route(f"/api/{name}", _answered(partial(_stepped, step)), method="post")
                for name, step in steps.items()
            ),
        ]

    async def close(self) -> None:
        """Goes back if a change was not kept, and ends all that the bench has started."""
        await self.trial.close()
        await self.registers.close()
        await self.scan.close()
        await self.running.end()

    async def _state(self, _: web.Request) -> dict[str, Any]:
        left = self.trial.left()
        return {
            "file": str(self.draft.path),
            "gateway": {"state": self.running.state, "log": [*self.running.log][-8:]},
            "ports": [*serial_ports(), SIMULATED],
            "protocols": protocols(),
            "settings": [*_SETTINGS, *other_settings()],
            "scan": self.scan.document(),
            "draft": await off_loop(self.draft.document),
            "left": left if left is None or left < float("inf") else -1,
            "said": self.trial.said,
        }

    async def _scan(self, data: Mapping[str, Any]) -> None:
        await self.registers.close()
        options = {name: str(value) for name, value in data.items()}
        await self.scan.start(options, self.running.config if self.running.state else None)

    async def _stations(self, data: Mapping[str, Any]) -> None:
        names = {str(number): str(name) for number, name in dict(data["names"]).items()}
        add = partial(self.draft.add_line, listen=self._listen, simulated=self.scan.simulated)
        chosen = self.scan.chosen(names)
        await off_loop(add, str(data["gateway"]), str(data["line"]), self.scan.port, chosen)

    async def _release(self) -> None:
        """Leaves the ports to the gateway: a wire has one master."""
        await self.scan.stop()
        await self.registers.close()

    async def _looking_on(self, change: Callable[[], Awaitable[None]]) -> None:
        """Makes a change, and looks at the same registers after it."""
        looked = self.registers.looked_at
        try:
            await change()
        finally:
            if looked is not None and self.registers.looked_at is None:
                with suppress(GatewayError):
                    await self.registers.look(await off_loop(self.draft.config), *looked)

    async def _look(self, data: Mapping[str, Any]) -> None:
        if self.scan.runs:
            raise ConfigError("a scan runs: stop it first")
        config = await off_loop(self.draft.config)
        await self.registers.look(config, str(data["device"]), str(data["range"]))

    async def _tags(self, data: Mapping[str, Any]) -> None:
        tags = {str(name): dict(one) for name, one in dict(data["tags"]).items()}
        await off_loop(self.draft.add_tags, str(data["device"]), tags)

    async def _take_sheet(self, request: web.Request) -> object:
        self._sheet = Path(request.query.get("name", "sheet")).name, await body(request)
        return await self._columns({"device": request.query.get("device", ""), "columns": {}})

    async def _columns(self, data: Mapping[str, Any]) -> object:
        return await off_loop(self.draft.sheet, *self._sheet, *_chosen(data))

    async def _import(self, data: Mapping[str, Any]) -> object:
        return await off_loop(self.draft.add_sheet, *self._sheet, *_chosen(data))

    async def _registers(self, _: web.Request) -> object:
        return self.registers.document(await off_loop(self.draft.config))

    async def _values(self, _: web.Request) -> object:
        if not self.running.state or self.running.config is None:
            return []
        rows = await self.running.ask(lambda client: client.values("**"))
        return values(self.running.config, rows, _MOST_VALUES)

    async def _write(self, data: Mapping[str, Any]) -> object:
        tag, value = str(data["tag"]), parse_value(str(data["value"]))
        return await self.running.ask(lambda client: client.requests.write(tag, value))


def _chosen(data: Mapping[str, Any]) -> tuple[str, dict[str, str]]:
    columns = {str(setting): str(title) for setting, title in dict(data["columns"]).items()}
    return str(data["device"]), columns


async def _stepped(step: Step, request: web.Request) -> object:
    data = json.loads(await body(request) or b"{}")
    return await step(data if isinstance(data, dict) else {})


def _answered(
    make: Callable[[web.Request], Awaitable[object]],
) -> Callable[[web.Request], Awaitable[web.Response]]:
    """Returns a handler: JSON, or 400 with a sentence."""

    async def handler(request: web.Request) -> web.Response:
        try:
            return as_json(await make(request))
        except GatewayError as error:
            return answer(400, str(error))
        except (ValueError, TypeError, KeyError):
            return answer(400, "this is no request of the page")

    return handler
