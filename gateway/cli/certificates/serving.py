"""The HTTPS side of an authority: newcomers with a code, renewals, the list of revoked ones."""

import asyncio
import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import structlog
from aiohttp import web
from pydantic import BaseModel, Field, ValidationError

from gateway.cli.certificates.authority import REVOKED, SERVER, Authority
from gateway.cli.certificates.state import read, sweep
from gateway.config.settings.parsers import web_address
from gateway.ending import stop_event
from gateway.errors import ConfigError, GatewayError, NotAllowed
from gateway.parts.web.connections import Connections, client_of
from gateway.parts.web.guard import Guard
from gateway.parts.web.listener import Listener
from gateway.parts.web.routes import Route, answer, body
from gateway.parts.web.settings import WebSection, WebTlsSection
from gateway.plant.threads import off_loop

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

WITHIN = 10.0  # seconds for the disk
SWEEP_EVERY = 60.0  # seconds
MOST_TRIES, TRIES_WITHIN = 10, 60.0  # of one address without a success, and seconds
MOST_ADDRESSES = 1000  # that are remembered
_PEM = "application/x-pem-file"


class Enrolment(BaseModel):
    """The request of a newcomer."""

    name: str = Field(max_length=64)
    secret: str = Field(max_length=64)
    request: str = Field(max_length=8192)


class Renewal(BaseModel):
    """The request of a gateway whose certificate ends soon."""

    certificate: str = Field(max_length=16_384)
    request: str = Field(max_length=8192)


class Desk:
    """The handlers. An address that was refused often waits: no code is guessed."""

    def __init__(self, authority: Authority) -> None:
        self._authority = authority
        self._tries: dict[str, tuple[int, float]] = {}  # by address: number, time of the first

    def routes(self) -> list[Route]:
        return [
            Route("/ca.pem", self._certificate, is_open=True),
            Route(f"/{REVOKED}", self._revoked, is_open=True),
            Route("/enrol", self._enrol, method="post", is_open=True),
            Route("/renew", self._renew, method="post", is_open=True),
        ]

    async def sweep(self) -> None:
        while True:
            await asyncio.sleep(SWEEP_EVERY)
            try:
                await off_loop(sweep, self._authority.folder, within=WITHIN)
            except GatewayError as error:
                log.error("codes not swept", why=str(error))  # noqa: TRY400  (our own error)

    async def _certificate(self, _: web.Request) -> web.Response:
        return web.Response(body=self._authority.certificate, content_type=_PEM)

    async def _revoked(self, _: web.Request) -> web.Response:
        file = self._authority.folder / REVOKED
        if not await off_loop(file.exists, within=WITHIN):
            return answer(404, "none is revoked")
        found = await off_loop(read, file, within=WITHIN)
        return web.Response(body=found, content_type=_PEM)

    async def _enrol(self, request: web.Request) -> web.Response:
        def signed(data: bytes) -> bytes:
            sent = Enrolment.model_validate_json(data)
            made = self._authority.enrol(sent.name, sent.secret, sent.request.encode())
            log.info("enrolled", name=sent.name, address=client)
            return made

        client = client_of(request.transport)
        return await self._answered(request, client, signed)

    async def _renew(self, request: web.Request) -> web.Response:
        def signed(data: bytes) -> bytes:
            sent = Renewal.model_validate_json(data)
            return self._authority.renew(sent.certificate.encode(), sent.request.encode())

        return await self._answered(request, client_of(request.transport), signed)

    async def _answered(
        self, request: web.Request, client: str, signed: Callable[[bytes], bytes]
    ) -> web.Response:
        if not self._may_try(client):
            return answer(429, "this address was refused too often: wait a minute")
        data = await body(request)
        try:
            made = await off_loop(signed, data, within=WITHIN)
        except ValidationError:
            status, why = 400, "the request has other fields than it should"
        except NotAllowed as error:
            status, why = 403, str(error)
        except ConfigError as error:
            status, why = 400, str(error)
        except GatewayError as error:
            log.error("not signed", why=str(error))  # noqa: TRY400  (our own error)
            return answer(503, "the authority cannot sign now: see its log")
        else:
            self._tries.pop(client, None)
            return web.Response(body=made, content_type=_PEM)
        log.warning("refused", address=client, why=why)
        return answer(status, why)

    def _may_try(self, client: str) -> bool:
        now = asyncio.get_running_loop().time()
        tries, since = self._tries.pop(client, (0, now))
        if now - since > TRIES_WITHIN:
            tries, since = 0, now
        self._tries[client] = tries + 1, since
        if len(self._tries) > MOST_ADDRESSES:
            del self._tries[next(iter(self._tries))]
        return tries < MOST_TRIES


async def serve(authority: Authority, at: str, listen: str) -> None:
    """Serves until SIGINT or SIGTERM. `at`: the address for gateways; empty: the one before.

    `listen`: host and port; empty: every address of this machine. Raises `ConfigError`.
    """
    at = at or authority.state().at
    if not at:
        raise ConfigError("write with --at where gateways reach this machine: --at ca.plant:8444")
    host, port = web_address(at)
    lock = _alone(authority.folder)
    try:
        await off_loop(authority.serve_at, at, within=WITHIN)
        files = (authority.folder / f"{SERVER}.{end}" for end in ("pem", "key"))
        changed = {
            "listen": web_address(listen) if listen else ("0.0.0.0", port),
            "tls": WebTlsSection.model_construct(
                None, **dict(zip(("certificate", "key"), files, strict=True))
            ),
            "names": [host.lower()],
        }
        config = WebSection().model_copy(update=changed)

        def ready(_port: int) -> None:
            log.info("authority ready", at=at, fingerprint=authority.fingerprint)

        desk, connections = Desk(authority), Connections()
        guard = Guard(config, connections)
        tasks = [
            asyncio.create_task(Listener(config, guard, connections, desk.routes()).run(ready)),
            asyncio.create_task(desk.sweep()),
            asyncio.create_task(stop_event().wait()),
        ]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        for task in done:
            task.result()
    finally:
        os.close(lock)


def _alone(folder: Path) -> int:
    """Returns an open lock. Raises `ConfigError` while another program serves the folder."""
    lock = os.open(folder / "serving", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        raise ConfigError(f"another plc-gateway ca serve runs for {folder}") from None
    return lock
