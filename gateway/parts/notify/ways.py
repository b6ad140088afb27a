"""The ways to people: mail, webhook, MQTT, a command, a telephone.

Each sends one message, or raises a `GatewayError` that says why not. The caller ends a try that
takes longer than `WITHIN`, or `DIALLED_WITHIN`.
"""

import asyncio
import base64
import binascii
import hashlib
import hmac
import os
import signal
import ssl
import subprocess
import threading
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any

import orjson

from gateway.errors import ConfigError, GatewayError
from gateway.parts.notify.answers import first_line, said, trusted
from gateway.parts.notify.mail import Mail
from gateway.parts.notify.message import Message
from gateway.parts.notify.settings import (
    MqttSection,
    NotifySection,
    TelephoneSection,
    WebhookSection,
)
from gateway.plant.threads import off_loop

WITHIN = 30.0  # seconds for one try
COMMAND_WITHIN = 25.0  # seconds
DIALLED_WITHIN = 300.0  # seconds: the modem may be in a call of its line

Send = Callable[[Message], Coroutine[Any, Any, None]]
Ring = Callable[[str, str], Coroutine[Any, Any, None]]  # line and number


def ways(settings: NotifySection, ring: Ring | None = None) -> dict[str, Send]:
    """Returns the ways that the rules use, by name. Each raises `GatewayError`.

    `ring` dials; None: another process has the modem.
    """
    used = dict.fromkeys(way for rule in settings.rules for way in rule.to)
    return {way: _way(way, settings, ring) for way in used}


async def why_not_sent(send: Send, message: Message) -> str:
    """Tries to send a message. Returns why it was not sent; empty: it was."""
    within = DIALLED_WITHIN if isinstance(send, _Telephone) else WITHIN
    try:
        async with asyncio.timeout(within):
            await send(message)
    except TimeoutError:
        return f"no answer within {within:g} s"
    except GatewayError as error:
        return str(error)
    return ""


def _way(way: str, settings: NotifySection, ring: Ring | None) -> Send:
    if way == "webhook" and settings.webhook is not None:
        return _Webhook(settings.webhook).send
    if way == "mqtt" and settings.mqtt is not None:
        return _Mqtt(settings.mqtt).send
    if way == "command" and settings.command is not None:
        return _Blocking(_Command(settings.command).send).send
    if way == "telephone" and settings.telephone is not None:
        return _Telephone(settings.telephone, ring)
    if settings.mail is None:
        raise ConfigError(f"notify: there is no {way}")
    to = settings.mail.to if way == "mail" else [way]
    return _Blocking(Mail(settings.mail, to).send).send


class _Telephone:
    """The message is the ring, or the code behind the number."""

    def __init__(self, settings: TelephoneSection, ring: Ring | None) -> None:
        self._settings = settings
        self._ring = ring

    async def __call__(self, _message: Message) -> None:
        if self._ring is None:
            raise GatewayError("only the gateway that runs dials: its line has the modem")
        await self._ring(self._settings.line, self._settings.number)


class _Blocking:
    """A way that blocks its thread. A try that does not end keeps the next from beginning: a server
    that never answers holds one thread."""

    def __init__(self, send: Callable[[Message], None]) -> None:
        self._send = send
        self._busy = threading.Lock()

    async def send(self, message: Message) -> None:
        await off_loop(self._alone, message)

    def _alone(self, message: Message) -> None:
        if not self._busy.acquire(blocking=False):
            raise GatewayError("the last try has no answer yet")
        try:
            self._send(message)
        finally:
            self._busy.release()


class _Webhook:
    """Signs as Standard Webhooks 1.0 says: HMAC-SHA256 over id, time and body."""

    def __init__(self, settings: WebhookSection) -> None:
        self._settings = settings

    async def send(self, message: Message) -> None:
        import aiohttp  # takes 0.1 s, and few plants have a webhook

        body, headers, context = await off_loop(self._prepare, message)
        try:
            async with (
                aiohttp.ClientSession(trust_env=False) as session,
                session.post(
                    self._settings.url.url,
                    data=body,
                    headers=headers,
                    ssl=context,
                    allow_redirects=False,
                ) as answer,
            ):
                if not 200 <= answer.status < 300:
                    text = f"the server answers {answer.status} {answer.reason}"
                    raise GatewayError(said(GatewayError(text)))
        except aiohttp.ClientResponseError:  # its text has the URL, which may hold a secret
            raise GatewayError("the server answers something that is no HTTP") from None
        except aiohttp.InvalidURL:
            raise GatewayError("notify.webhook.url is no address") from None
        except (aiohttp.ClientError, OSError, ValueError) as error:
            raise GatewayError(said(error)) from None

    def _prepare(self, message: Message) -> tuple[bytes, dict[str, str], ssl.SSLContext | bool]:
        """Blocks: it reads files."""
        settings = self._settings
        body = orjson.dumps(message.document)
        sent = str(int(datetime.now(UTC).timestamp()))
        headers = {
            "content-type": "application/json",
            "webhook-id": message.id,
            "webhook-timestamp": sent,
        }
        if settings.secret_file is not None:
            secret = first_line(settings.secret_file, "webhook")
            headers["webhook-signature"] = signature(secret, f"{message.id}.{sent}.", body)
        return body, headers, trusted(settings.ca) if settings.url.scheme == "https" else True


def signature(secret: str, begin: str, body: bytes) -> str:
    """Returns the header. `secret`: any text, or `whsec_` and base64. Raises `GatewayError`."""
    key = secret.encode()
    if secret.startswith("whsec_"):
        try:
            key = base64.b64decode(secret.removeprefix("whsec_"), validate=True)
        except binascii.Error:
            raise GatewayError("notify.webhook.secret_file: no base64 after whsec_") from None
    signed = hmac.digest(key, begin.encode() + body, hashlib.sha256)
    return f"v1,{base64.b64encode(signed).decode()}"


class _Mqtt:
    def __init__(self, settings: MqttSection) -> None:
        try:
            import aiomqtt
        except ImportError:
            text = "notify.mqtt needs one more package: pip install aiomqtt"
            raise ConfigError(text) from None
        self._settings = settings
        self._library = aiomqtt

    async def send(self, message: Message) -> None:
        settings, at = self._settings, self._settings.broker
        password, context = await off_loop(self._prepare)
        try:
            async with self._library.Client(
                at.host,
                at.port,
                username=settings.user,
                password=password,
                tls_context=context,
                timeout=WITHIN,
            ) as client:
                await client.publish(settings.topic, orjson.dumps(message.document), qos=1)
        except (self._library.MqttError, OSError, ValueError) as error:
            raise GatewayError(said(error)) from None

    def _prepare(self) -> tuple[str | None, ssl.SSLContext | None]:
        """Blocks: it reads files."""
        settings = self._settings
        file = settings.password_file
        password = None if file is None else first_line(file, "mqtt")
        is_tls = settings.broker.scheme == "mqtts"
        return password, trusted(settings.ca) if is_tls else None


class _Command:
    def __init__(self, command: Sequence[str]) -> None:
        self._command = command

    def send(self, message: Message) -> None:
        try:
            process = subprocess.Popen(  # noqa: S603  (the file names it)
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        except (OSError, ValueError) as error:
            raise GatewayError(f"{self._command[0]}: {said(error)}") from None
        with process:
            try:
                process.communicate(orjson.dumps(message.document), timeout=COMMAND_WITHIN)
            except subprocess.TimeoutExpired:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                raise GatewayError(f"{self._command[0]} has not ended: killed") from None
        if process.returncode != 0:
            raise GatewayError(f"{self._command[0]} ended with {process.returncode}")
