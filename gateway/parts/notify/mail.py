"""Mail, as one of the ways to people: by SMTP, with TLS where the server has it."""

import smtplib
import socket
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from email.message import EmailMessage
from email.utils import format_datetime

import structlog

from gateway.errors import GatewayError
from gateway.parts.notify.answers import first_line, said, trusted
from gateway.parts.notify.message import Message
from gateway.parts.notify.settings import MailSection, Server

log = structlog.get_logger("gateway")
_STEP_WITHIN = 10.0  # seconds for each answer of a mail server
_ALL_WITHIN = 30.0  # seconds for all of them
_MOST_REPLIES = 65_536  # bytes of one connection to a mail server


class _Replies:
    """The replies of a mail server, as the file that smtplib reads: bounded in bytes and time. A
    reply of many lines may have no end, or a line may arrive byte by byte."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._heard, self._bytes = b"", 0
        self._ends = time.monotonic() + _ALL_WITHIN

    def readline(self, _most: int) -> bytes:
        while b"\n" not in self._heard:
            if self._bytes > _MOST_REPLIES or time.monotonic() > self._ends:
                raise OSError("its reply has no end")
            if not (data := self._connection.recv(4096)):
                return b""
            self._heard, self._bytes = self._heard + data, self._bytes + len(data)
        line, _, self._heard = self._heard.partition(b"\n")
        return line + b"\n"

    def close(self) -> None:
        """The connection is smtplib's."""


class _Server(smtplib.SMTP):
    def getreply(self) -> tuple[int, bytes]:
        if self.file is None and self.sock is not None:
            self.file = _Replies(self.sock)
        return super().getreply()


class _TlsServer(_Server, smtplib.SMTP_SSL):
    pass


class Mail:
    def __init__(self, settings: MailSection, to: Sequence[str]) -> None:
        self._settings = settings
        self._to = to

    def send(self, message: Message) -> None:
        settings = self._settings
        refused: dict[str, tuple[int, bytes]] | None = None  # of a mail that the server has taken
        try:
            with self._connected(settings.server) as server:
                if settings.user and settings.password_file:
                    server.login(settings.user, first_line(settings.password_file, "mail"))
                refused = server.send_message(_mail(message, settings.from_, self._to))
        except smtplib.SMTPRecipientsRefused as error:
            raise GatewayError(f"the server refuses {', '.join(error.recipients)}") from None
        except (OSError, smtplib.SMTPException, ValueError) as error:
            if refused is None:  # later only the farewell was wrong: the mail is sent once
                raise GatewayError(said(error)) from None
        if refused:
            log.warning("mail refused", to=[*refused], effect="the others have it")

    def _connected(self, at: Server) -> smtplib.SMTP:
        if at.scheme == "smtps":
            context = trusted(self._settings.ca)
            return _TlsServer(at.host, at.port, timeout=_STEP_WITHIN, context=context)
        server = _Server(at.host, at.port, timeout=_STEP_WITHIN)
        try:
            server.ehlo()
            if server.has_extn("starttls") or not at.is_local:
                server.starttls(context=trusted(self._settings.ca))
        except (OSError, smtplib.SMTPException, ValueError):
            server.close()
            raise
        return server


def _mail(message: Message, sender: str, to: Sequence[str]) -> EmailMessage:
    mail = EmailMessage()
    mail["From"], mail["To"] = sender, ", ".join(to)
    mail["Subject"] = "".join(c if c.isprintable() else " " for c in message.subject)
    mail["Date"] = format_datetime(datetime.fromtimestamp(message.time / 1e9, UTC))
    mail["Message-ID"] = f"<{message.id}@{sender.partition('@')[2]}>"
    mail["Auto-Submitted"] = "auto-generated"  # no reply of a machine, please
    mail.set_content(message.text)
    return mail
