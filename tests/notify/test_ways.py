"""The ways with real peers: a mail server, an HTTP server, mosquitto, programs."""

import asyncio
import json
import socket
import ssl
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from email import message_from_bytes
from email.policy import default
from pathlib import Path
from typing import Any

import pytest
from aiohttp import web
from aiosmtpd.controller import Controller
from aiosmtpd.smtp import AuthResult, Envelope, LoginPassword, Session
from structlog.testing import capture_logs

from gateway.config import load
from gateway.errors import GatewayError
from gateway.parts.notify.message import Message, message
from gateway.parts.notify.settings import NotifySection
from gateway.parts.notify.watch import TEST
from gateway.parts.notify.ways import Send, signature, ways
from tests.e2e.processes import Program, until
from tests.northbound.access import certificates
from tests.zenoh_peer import free_endpoint, free_port

SENT: Message = message("plant", "demo", [TEST], 10**18)


def way(folder: Path, name: str, **section: Any) -> Send:
    """Returns the way of a file with this section."""
    text = {
        "zenoh": {"listen": [free_endpoint()]},
        "notify": {name: section.get("list", section), "rules": [{"to": [name]}]},
        "lines": {
            "hall": {"port": "simulator", "devices": {"m": {"protocol": "vigor", "tags": {}}}}
        },
    }
    path = folder / "plant.yaml"
    path.write_text(json.dumps(text))
    settings = load(path).part(NotifySection)
    assert settings is not None
    return ways(settings)[name]


class Mailbox:
    """A handler of aiosmtpd."""

    def __init__(self) -> None:
        self.mails: list[bytes] = []
        self.answer = "250 OK"

    async def handle_DATA(self, _server: Any, _session: Session, envelope: Envelope) -> str:
        assert isinstance(envelope.content, bytes)
        self.mails.append(envelope.content)
        return self.answer


@contextmanager
def mail_server(box: Mailbox, port: int | None = None, **how: Any) -> Iterator[int]:
    port = port or free_port()
    server = Controller(box, hostname="127.0.0.1", port=port, **how)
    server.start()
    try:
        yield port
    finally:
        server.stop()


def _check(_server: Any, _session: Any, _envelope: Any, _kind: str, data: Any) -> AuthResult:
    is_right = isinstance(data, LoginPassword) and data.password == b"a long password"
    return AuthResult(success=is_right, handled=False)


@pytest.fixture
def password(tmp_path: Path) -> Path:
    file = tmp_path / "password"
    file.write_text("a long password\nnot this\n")
    file.chmod(0o600)
    return file


def test_a_mail_arrives_by_tls_and_with_a_password(tmp_path: Path, password: Path) -> None:
    box, context = Mailbox(), ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*certificates(tmp_path)("mail"))
    people = ["shift@plant.example", "ana@plant.example"]
    known = {"from": "gateway@plant.example", "to": people, "ca": str(tmp_path / "ca.pem")}
    user = {"user": "gateway", "password_file": str(password)}
    with mail_server(box, tls_context=context, auth_required=True, authenticator=_check) as port:
        by_tls = {**known, "server": f"smtp://127.0.0.1:{port}"}
        asyncio.run(way(tmp_path, "mail", **by_tls, **user)(SENT))
        with pytest.raises(GatewayError, match="Authentication required"):
            asyncio.run(way(tmp_path, "mail", **by_tls)(SENT))
        password.write_text("another one\n")
        with pytest.raises(GatewayError, match="credentials"):
            asyncio.run(way(tmp_path, "mail", **by_tls, **user)(SENT))
        password.chmod(0o644)
        with pytest.raises(GatewayError, match="chmod o-rwx"):
            asyncio.run(way(tmp_path, "mail", **by_tls, **user)(SENT))
        with pytest.raises(GatewayError, match="certificate"):
            asyncio.run(way(tmp_path, "mail", **{**by_tls, "ca": None})(SENT))
    (mail,) = (message_from_bytes(one, policy=default) for one in box.mails)
    assert (mail["from"], mail["to"]) == ("gateway@plant.example", ", ".join(people))
    assert mail["subject"] == SENT.subject
    assert mail["message-id"] == f"<{SENT.id}@plant.example>"
    assert mail.get_content().split() == SENT.text.split()  # its lines are wrapped


def test_a_mail_that_the_server_refuses_is_not_sent(tmp_path: Path) -> None:
    box = Mailbox()
    box.answer = "554 no room\x1b[2J"
    with mail_server(box) as port:
        known = {"from": "a@b.example", "to": ["c@d.example"]}
        send = way(tmp_path, "mail", server=f"smtp://127.0.0.1:{port}", **known)
        with pytest.raises(GatewayError, match="554") as raised:
            asyncio.run(send(SENT))
        assert str(raised.value).isprintable()
    with pytest.raises(GatewayError, match="refused"):
        asyncio.run(send(SENT))


def test_a_mail_is_sent_once_whatever_the_server_says_then_and_who_is_refused_is_said(
    tmp_path: Path,
) -> None:
    class Odd(Mailbox):
        async def handle_RCPT(
            self, _server: Any, _session: Session, envelope: Envelope, to: str, _options: Any
        ) -> str:
            if to.startswith("gone"):
                return "550 no such person"
            envelope.rcpt_tos.append(to)
            return "250 OK"

        async def handle_QUIT(self, _server: Any, _session: Session, _envelope: Any) -> str:
            return "421 tired"

    box = Odd()
    with mail_server(box) as port, capture_logs() as logs:
        known = {"from": "a@b.example", "to": ["gone@d.example", "c@d.example"]}
        asyncio.run(way(tmp_path, "mail", server=f"smtp://127.0.0.1:{port}", **known)(SENT))
    assert len(box.mails) == 1
    [entry] = [one for one in logs if one["event"] == "mail refused"]
    assert entry["to"] == ["gone@d.example"]


async def test_a_mail_server_that_never_answers_holds_one_thread(tmp_path: Path) -> None:
    known = {"from": "a@b.example", "to": ["c@d.example"]}
    async with asyncio.timeout(300):
        with socket.create_server(("127.0.0.1", 0)) as silent:  # it accepts no connection
            port = silent.getsockname()[1]
            send = way(tmp_path, "mail", server=f"smtp://127.0.0.1:{port}", **known)
            tries = {asyncio.ensure_future(send(SENT)) for _ in range(3)}
            done, pending = await asyncio.wait(tries, return_when=asyncio.FIRST_COMPLETED)
            while len(pending) > 1:
                more, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
                done |= more
            assert all("no answer yet" in str(one.exception()) for one in done)
        (first,) = pending  # its connection is reset
        with pytest.raises(GatewayError):
            await first


async def _answered(
    tmp_path: Path, answer: Callable[[web.Request], Awaitable[web.StreamResponse]], **more: Any
) -> None:
    app = web.Application()
    app.router.add_post("/alarms", answer)
    runner = web.AppRunner(app)
    await runner.setup()
    port = free_port()
    await web.TCPSite(runner, "127.0.0.1", port).start()
    try:
        await way(tmp_path, "webhook", url=f"http://127.0.0.1:{port}/alarms", **more)(SENT)
    finally:
        await runner.cleanup()


def test_the_signature_is_that_of_standard_webhooks() -> None:
    secret = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"  # noqa: S105  (an example of the standard)
    begin = "msg_p5jXN8AQM9LWM0D4loKWxJek.1614265330."
    signed = "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE="
    assert signature(secret, begin, b'{"test": 2432232314}') == signed
    with pytest.raises(GatewayError, match="base64"):
        signature("whsec_?", begin, b"")


async def test_a_webhook_gets_the_signed_document(tmp_path: Path, password: Path) -> None:
    seen = list[dict[str, Any]]()

    async def take(request: web.Request) -> web.Response:
        body = await request.read()
        begin = f"{request.headers['webhook-id']}.{request.headers['webhook-timestamp']}."
        assert request.headers["webhook-signature"] == signature("a long password", begin, body)
        seen.append(json.loads(body))
        return web.Response(status=204)

    await _answered(tmp_path, take, secret_file=str(password))
    assert seen == [dict(SENT.document)]


@pytest.mark.parametrize(
    ("status", "headers"), [(500, {}), (404, {}), (302, {"location": "http://192.0.2.1/"})]
)
async def test_a_webhook_that_is_not_answered_by_success_is_not_sent(
    tmp_path: Path, status: int, headers: dict[str, str]
) -> None:
    async def refuse(_request: web.Request) -> web.Response:
        return web.Response(status=status, headers=headers, reason="x" * 5000)

    with pytest.raises(GatewayError, match=f"answers {status} xxx") as raised:
        await _answered(tmp_path, refuse)
    assert len(str(raised.value)) == 200  # it is shown in status and log


async def test_an_answer_without_an_end_is_a_success_at_once(tmp_path: Path) -> None:
    """Waiting for its end would send the message again, for ever."""

    async def dribble(request: web.Request) -> web.StreamResponse:
        answer = web.StreamResponse()
        await answer.prepare(request)
        with suppress(ConnectionError):
            while True:
                await answer.write(b"x")
                await asyncio.sleep(0)
        return answer

    async with asyncio.timeout(300):  # the way itself would fail after 30 s
        await _answered(tmp_path, dribble)


async def test_the_url_of_a_webhook_is_in_no_error(tmp_path: Path) -> None:
    """It may hold a secret, as those of chats do, and the error is in `status` and the log."""

    async def refuse(_request: web.Request) -> web.Response:
        return web.Response(headers={"x": "y" * 10_000})

    with pytest.raises(GatewayError, match="no HTTP") as raised:
        await _answered(tmp_path, refuse)
    assert "127.0.0.1" not in str(raised.value)


def test_a_message_reaches_a_broker(tmp_path: Path) -> None:
    port = free_port()
    broker = ("mosquitto", "-p", port, "-v")
    with Program(*broker) as server:
        server.says("running")
        listen = ("mosquitto_sub", "-h", "127.0.0.1", "-p", port, "-t", "hall/alarms")
        with Program(*listen) as client:
            server.says("Sending SUBACK")
            send = way(tmp_path, "mqtt", broker=f"mqtt://127.0.0.1:{port}", topic="hall/alarms")
            asyncio.run(send(SENT))
            client.says(SENT.id)
    with pytest.raises(GatewayError):
        asyncio.run(send(SENT))


@pytest.mark.parametrize(
    ("command", "why"),
    [
        (["/bin/sh", "-c", "cat > got; exit 0"], ""),
        (["/bin/sh", "-c", "exit 3"], "/bin/sh ended with 3"),
        (["/nowhere/siren"], "/nowhere/siren: .*No such file"),
        (["/bin/true"], ""),  # it does not read what it gets
    ],
)
def test_a_command_gets_the_document(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: list[str], why: str
) -> None:
    monkeypatch.chdir(tmp_path)
    send = way(tmp_path, "command", list=command)
    if why:
        with pytest.raises(GatewayError, match=why):
            asyncio.run(send(SENT))
        return
    asyncio.run(send(SENT))
    if "got" in command[-1]:
        assert json.loads((tmp_path / "got").read_text()) == SENT.document


def test_a_command_that_does_not_end_is_killed_with_its_children(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.parts.notify.ways.COMMAND_WITHIN", 0.3)
    file = tmp_path / "child"
    send = way(tmp_path, "command", list=["/bin/sh", "-c", f"sleep 600 & echo $! > {file}; wait"])
    with pytest.raises(GatewayError, match="killed"):
        asyncio.run(send(SENT))
    if file.exists():  # a slow machine may not have come so far
        child = Path(f"/proc/{file.read_text().strip() or 0}/cmdline")
        until(lambda: not child.exists() or child.read_bytes() == b"", "the child ends")


@pytest.mark.parametrize("more", [b"250-and more\r\n" * 300, b"2" * 4000], ids=["lines", "line"])
async def test_a_mail_server_whose_reply_has_no_end_costs_no_memory(
    tmp_path: Path, more: bytes
) -> None:
    """The thread read it for ever: 4 GB in 40 s."""

    async def answer(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"220 mail.plant\r\n")
        with suppress(ConnectionError):
            while not writer.is_closing():
                writer.write(more)
                await writer.drain()

    server = await asyncio.start_server(answer, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    known = {"from": "a@b.example", "to": ["c@d.example"]}
    async with server, asyncio.timeout(300):
        with pytest.raises(GatewayError, match=r"no end|too long"):
            await way(tmp_path, "mail", server=f"smtp://127.0.0.1:{port}", **known)(SENT)
