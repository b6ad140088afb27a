"""The section `notify` of the file: which alarms reach whom, and on which way."""

import re
from dataclasses import dataclass
from datetime import time
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from pydantic import Field

from gateway.config.messages import Mistakes, meant, shown
from gateway.config.messages import Path as Setting
from gateway.config.settings.modem_settings import NUMBER_PATTERN, phone_number
from gateway.config.settings.sections import PartSection, Place, Written
from gateway.config.settings.session_model import Section
from gateway.config.settings.setting_types import Duration, FilePath, Interval, Parsed, Text
from gateway.contract.languages import Language
from gateway.errors import ConfigError
from gateway.tags import Priority
from gateway.transport.port import is_loopback

WAYS = ("mail", "webhook", "mqtt", "command", "telephone")
Day = Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"]
DAYS: tuple[Day, ...] = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
_MAIL_ADDRESS = re.compile(r"[\w.+-]+@[\w.-]+\Z", re.ASCII)
_TIME = "[0-2][0-9]:[0-5][0-9]"
_TIMES = re.compile(r"([01]\d|2[0-3]):([0-5]\d) ?- ?([01]\d|2[0-3]):([0-5]\d)\Z")
_PORTS = {"smtps": 465, "smtp": 587, "mqtt": 1883, "mqtts": 8883, "https": 443, "http": 80}


@dataclass(frozen=True, slots=True)
class Server:
    """The address of a server. `scheme`: the part of the address before `://`."""

    scheme: str
    host: str
    port: int
    url: str

    @property
    def is_local(self) -> bool:
        """True if no other machine sees what is sent."""
        return is_loopback(self.host)


def _server(*schemes: str) -> Parsed:
    example = f"{schemes[0]}://{schemes[0].rstrip('s')}.plant.example"

    def parse(text: object) -> Server:
        try:
            found = urlsplit(text if isinstance(text, str) else "")
            port = found.port
        except ValueError:
            found, port = urlsplit(""), None
        if found.scheme not in schemes or not found.hostname or found.username or port == 0:
            raise ConfigError(f"{shown(text)} is no server: write it as {example}")
        return Server(found.scheme, found.hostname, port or _PORTS[found.scheme], str(text))

    pattern = rf"^({'|'.join(schemes)})://[^\s@]+$"
    return Parsed(parse, {"type": "string", "pattern": pattern, "examples": [example]})


def _mail_address(text: object) -> str:
    if not isinstance(text, str) or not _MAIL_ADDRESS.match(text):
        raise ConfigError(f"{shown(text)} is no mail address: write it as shift@plant.example")
    return text


def _times(text: object) -> tuple[time, time]:
    if not (found := _TIMES.match(text if isinstance(text, str) else "")):
        raise ConfigError(f"{shown(text)} is no time of the day: write it as 22:00-06:00")
    hour, minute, last_hour, last_minute = map(int, found.groups())
    return time(hour, minute), time(last_hour, last_minute)


MailAddress = Annotated[str, Parsed(_mail_address, {"type": "string", "format": "email"})]
Times = Annotated[
    tuple[time, time] | None,
    Parsed(
        _times, {"type": "string", "pattern": "^[0-2][0-9]:[0-5][0-9] ?- ?[0-2][0-9]:[0-5][0-9]$"}
    ),
]


class MailSection(Section):
    """Mail by SMTP."""

    server: Annotated[Server, _server("smtps", "smtp")]
    """smtps:// for TLS from the first byte, smtp:// for STARTTLS; without TLS on this machine
    only."""
    from_: Annotated[MailAddress, Field(alias="from")]
    """The address of the sender."""
    to: Annotated[list[MailAddress], Field(min_length=1)]
    """The addresses that `to: [mail]` of a rule means."""
    user: Text | None = None
    """The name that the server knows; left out: the gateway does not sign in."""
    password_file: FilePath | None = None
    """The file whose first line is the password; not readable by other users of this machine."""
    ca: FilePath | None = None
    """The certificate authority of the server, as a PEM file; left out: those of this machine."""


class WebhookSection(Section):
    """A POST of JSON for each message, signed as Standard Webhooks."""

    url: Annotated[Server, _server("https", "http")]
    """The address; http:// is neither secret nor safe from changes."""
    secret_file: FilePath | None = None
    """The file whose first line signs the messages; left out: they have no signature."""
    ca: FilePath | None = None
    """The certificate authority of the server, as a PEM file; left out: those of this machine."""


class MqttSection(Section):
    """A message to a broker, with quality of service 1."""

    broker: Annotated[Server, _server("mqtts", "mqtt")]
    """The broker, such as mqtts://broker.plant.example."""
    topic: Text = "plant/alarms"
    """The topic of all messages."""
    user: Text | None = None
    """The name that the broker knows; left out: the gateway does not sign in."""
    password_file: FilePath | None = None
    """The file whose first line is the password; not readable by other users of this machine."""
    ca: FilePath | None = None
    """The certificate authority of the broker, as a PEM file; left out: those of this machine."""


class TelephoneSection(Section):
    """A telephone or a pager, which the modem of a line dials between its calls."""

    line: Text
    """The line with the modem."""
    number: Annotated[str, Parsed(phone_number, {"type": "string", "pattern": NUMBER_PATTERN})]
    """The telephone number, in quotes; `,` is a pause of 2 s, also to let it ring or before a
    code: "0,26204393,,,,911"."""


class RuleSection(Section):
    """Which alarms reach whom. Each rule is applied by itself."""

    to: Annotated[list[Text], Field(min_length=1)]
    """The ways: mail, webhook, mqtt, command, telephone; or a mail address."""
    priority: Literal["critical", "high", "medium", "low"] = "low"
    """Alarms of this priority, and more urgent ones."""
    alarms: Annotated[list[Text], Field(min_length=1)] = ["*"]
    """Keys of alarms, also with *, such as mixer/*, line:hall-1 or gateway:*."""
    after: Duration = 0.0
    """Only alarms that are not acknowledged for so long."""
    again: Interval | None = None
    """Reminds of active alarms at this interval, until they are acknowledged."""
    ended: bool = True
    """Also sends the end of an alarm."""
    pause: Duration = 60.0
    """The shortest time between two messages: what happens meanwhile is one message."""
    between: Times = None
    """The time of the day, by the clock of this machine, such as 22:00-06:00."""
    days: list[Day] = list(DAYS)
    """The days of the week."""


class NotifySection(Section):
    """Alarms that reach people: docs/notify.md."""

    mail: MailSection | None = None
    """Mail by SMTP."""
    webhook: WebhookSection | None = None
    """A POST of JSON for each message."""
    mqtt: MqttSection | None = None
    """A message to a broker."""
    command: Annotated[list[Text], Field(min_length=1)] | None = None
    """A program and its arguments: it gets each message as JSON on its standard input."""
    telephone: TelephoneSection | None = None
    """A telephone that the modem of a line dials."""
    language: Language = "en"
    """The language of mails; documents stay English."""
    rules: Annotated[list[RuleSection], Field(min_length=1)]
    """Which alarms reach whom."""
    path: FilePath = Path("notify.json")
    """Keeps what was sent and what waits across restarts."""
    keep: Interval = 86400.0
    """A message that could not be sent for so long is dropped."""


@dataclass(frozen=True, slots=True)
class Rule:
    """One checked rule. Times in seconds."""

    key: str  # the same after a restart with the same file
    to: tuple[str, ...]
    priorities: frozenset[str]
    alarms: tuple[str, ...]
    after: float
    again: float | None
    ended: bool
    pause: float
    between: tuple[time, time] | None
    days: frozenset[int]  # 0: Monday

    def concerns(self, alarm: str, priority: str) -> bool:
        return priority in self.priorities and any(
            fnmatchcase(alarm, pattern) for pattern in self.alarms
        )


def rules_of(settings: NotifySection) -> tuple[Rule, ...]:
    """Returns the rules of the file."""
    order = [one.value for one in Priority]
    return tuple(
        Rule(
            f"{number} {' '.join(one.to)}",
            tuple(dict.fromkeys(one.to)),
            frozenset(order[: order.index(one.priority) + 1]),
            tuple(one.alarms),
            one.after,
            one.again,
            one.ended,
            one.pause,
            one.between,
            frozenset(map(DAYS.index, one.days)),
        )
        for number, one in enumerate(settings.rules, 1)
    )


def _place(settings: NotifySection | None, place: Place) -> NotifySection | None:
    if settings is None:
        return None
    for number, rule in enumerate(settings.rules):
        for which, way in enumerate(rule.to):
            if why := _why_not(settings, way):
                place.mistakes.add(why, "notify", "rules", number, "to", which)
    for name in ("mail", "mqtt"):
        if (section := getattr(settings, name)) is not None:
            _check_server(name, section, place.mistakes)
    if (telephone := settings.telephone) is not None:
        dial = [line.name for line in place.lines if line.modem and line.modem.number]
        if telephone.line not in dial:
            why = f"is no line whose modem dials: {meant(telephone.line, dial)}"
            at = ("notify", "telephone", "line")
            place.mistakes.add(f"{shown(telephone.line)} {why}", *at)
    files: dict[str, Any] = {"path": place.written(settings.path)}
    for name, setting, file in _files(settings):
        found = place.existing(file, "notify", name, setting)
        section = files.get(name, getattr(settings, name))
        files[name] = section.model_copy(update={setting: found})
    return settings.model_copy(update=files)


def _why_not(settings: NotifySection, way: str) -> str:
    if "@" in way:
        if not _MAIL_ADDRESS.match(way):
            return f"{shown(way)} is no mail address"
        return "" if settings.mail else "write `mail: {server: ..., from: ..., to: [...]}` too"
    if way not in WAYS:
        return f"{shown(way)} is no way: {meant(way, WAYS)}"
    return "" if getattr(settings, way) else f"write `{way}: ...` beside `rules` too"


def _check_server(name: str, section: Any, mistakes: Mistakes) -> None:
    """A user has a password, and a password needs TLS."""
    setting: Setting = ("notify", name)
    user, password = section.user, section.password_file
    if (user is None) != (password is None):
        mistakes.add("user and password_file belong together: write both or none", *setting)
    if user and name == "mqtt" and section.broker.scheme == name and not section.broker.is_local:
        text = "mqtt:// would show the password to the network: write mqtts://"
        mistakes.add(text, *setting, "broker")


def _files(settings: NotifySection) -> list[tuple[str, str, Path | None]]:
    return [
        (name, setting, getattr(section, setting))
        for name in ("mail", "webhook", "mqtt")
        if (section := getattr(settings, name)) is not None
        for setting in ("password_file", "secret_file", "ca")
        if getattr(section, setting, None) is not None
    ]


def _reads(settings: NotifySection) -> list[tuple[str, Path | None]]:
    return [(f"notify.{name}.{setting}", file) for name, setting, file in _files(settings)]


def _writes(settings: NotifySection) -> list[Written]:
    return [Written(("notify", "path"), settings.path, ("", ".new", ".bad"), "notify.json")]


SECTION = PartSection(
    name="notify", settings=NotifySection, place=_place, writes=_writes, reads=_reads
)
