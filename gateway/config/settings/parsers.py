"""Parsers of single settings: `500ms`, `1GB`, `2%`, `7E1`, names, key prefixes.

Each takes a value of the file, of any type, and raises `ConfigError` with a correct example.
"""

import math
import re
import unicodedata
from collections.abc import Callable
from ipaddress import IPv4Network, IPv6Network, ip_address, ip_network
from pathlib import Path
from typing import Literal

from gateway.config.messages import shown
from gateway.errors import ConfigError
from gateway.files import is_name
from gateway.protocols.frames.bytetext import octets
from gateway.transport.port import (
    LONGEST_REGISTRATION,
    MODEM,
    PortAddress,
    SerialPath,
    parse_port,
)
from gateway.values import ValueType, parse_type
from gateway.values.numerals import TIMES, nanoseconds

_WITH_UNIT = re.compile(r"[0-9.]+ ?([A-Za-zµ]+)\Z")
_COMMA = re.compile(r"-?[0-9]+,[0-9]+ ?[A-Za-zµ%]*\Z")
_SIZE = re.compile(r"([0-9]+(?:\.[0-9]+)?) ?([kKMGT]B)\Z")
BYTES = {"kB": 10**3, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
_CURLY = "“”„‟‘’‚«»"
_HOST_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?\Z")
_WEB = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[^\[\]/:\s]+):([0-9]{1,5})\Z")
_ORIGIN = re.compile(r"https?://(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+)(:[0-9]{1,5})?\Z")
_ENDPOINT = re.compile(r"[a-z][a-z0-9_-]*/[^\s/]\S*\Z")
_WITH_PORT = ("tcp", "udp", "tls", "quic", "ws")
_SERVER = re.compile(r"(?:([^/\\:\s]+):)?([0-9]+)\Z")  # as in its manual: `4001`, `10.0.0.7:4001`
_HOST = re.compile(r"[0-9]{1,3}(?:\.[0-9]{1,3}){3}\Z")
_WINDOWS = re.compile(r"(?:\\\\\.\\)?COM ?[0-9]+\Z", re.IGNORECASE)
_FORMAT = re.compile(r"[78][NEO][12]\Z")
# Rates of serial ports and PLCs; a typing mistake is rarely one of them.
BAUDRATES = (
    *(110, 300, 600, 1200, 2400, 4800, 9600, 14400, 19200, 28800, 31250, 38400, 56000, 57600),
    *(76800, 115200, 128000, 187500, 230400, 250000, 256000, 460800, 500000, 576000, 921600),
    *(1000000, 1152000, 1500000, 2000000, 2500000, 3000000, 3500000, 4000000),
)
# Bytes in UTF-8: a name is part of the name of a file, which has at most 255.
LONGEST_NAME = 200
_LONGEST_TIME = 3650 * 86400.0  # ten years; more is a mistake, and clocks overflow

DURATIONS = "500ms, 2s, 15min, 1h30m or 7d"


def duration(text: object) -> float:
    """Parses `500ms` as 0.5 seconds, and `1h30m`. Refuses a number without unit."""
    if isinstance(text, (int, float)) and not isinstance(text, bool) and 0 < text < _LONGEST_TIME:
        number = shown(text)
        raise ConfigError(f"{number} has no unit: write {number}s or {number}ms")
    time = nanoseconds(text) if isinstance(text, str) else None
    if time is None:
        if isinstance(text, str) and (match := _WITH_UNIT.match(text)) and match[1] not in TIMES:
            hint = "min for minutes" if match[1] == "M" else "ms, s, min, h or d"
            raise ConfigError(f"{text}: {match[1]} is no unit of time: use {hint}")
        write = with_point(text) or DURATIONS
        raise ConfigError(f"{shown(text)} is no duration: write {write}")
    seconds = round(time / 10**9, 7)
    if seconds > _LONGEST_TIME:
        raise ConfigError(f"{text} is longer than ten years")
    return seconds


def with_point(text: object) -> str | None:
    """Returns a number with a decimal comma as the file needs it, with a point; else None."""
    if isinstance(text, str) and _COMMA.match(text):
        return text.replace(",", ".")
    return None


def unit(text: object) -> str:
    """Parses a unit of measurement."""
    plain = _text(text)
    if {*plain[:1], *plain[-1:]} & {*_CURLY}:
        raise ConfigError(f"{plain} has curly quotes: write {plain.strip(_CURLY)!r}")
    return plain


def interval(text: object) -> float:
    """Parses a duration that is not zero."""
    seconds = duration(text)
    if seconds == 0:
        raise ConfigError(f"{text}: an interval is longer than zero, such as 500ms")
    return seconds


def size(text: object) -> int:
    """Parses `1GB` as 1000000000 bytes."""
    match = _SIZE.match(text) if isinstance(text, str) else None
    if match is None:
        raise ConfigError(f"{shown(text)} is no size: write 500MB or 1GB")
    octets = int(float(match[1]) * BYTES[match[2]])
    if octets < 10**6:
        raise ConfigError(f"{text} is too little: use at least 1MB")
    return octets


def name(text: object, *, slashes: bool = False) -> str:
    """Parses a name: letters and digits of any script, `_`, `-` and `.`.

    Returns it in composed form (NFC), so that it is one key however it was typed.
    """
    text = unicodedata.normalize("NFC", _text(text))
    if not text:
        raise ConfigError("a name needs at least one character")
    for letter in text:
        if not (letter in "_-." or (slashes and letter == "/") or _lettered(letter)):
            also = ", `/`" if slashes else ""
            raise ConfigError(
                f"{text!r} has {_spelt(letter)}: names are letters and digits, `_`, `-`, `.`{also}"
            )
    if slashes and ("" in text.split("/")):
        raise ConfigError(f"{text!r}: a `/` separates two parts of a name and cannot be at its end")
    if (octets := len(text.encode())) > LONGEST_NAME:
        long = f"{shown(text)} has {octets} bytes in UTF-8"
        raise ConfigError(f"{long}, and a name at most {LONGEST_NAME}: shorten it")
    return text


def tag_name(text: object) -> str:
    """Parses a name with optional `/` inside."""
    return name(text, slashes=True)


def prefix(text: object) -> str:
    """Parses a Zenoh key prefix of one or more chunks, each a name: `plant/site-1`."""
    text = _text(text)
    for chunk in text.split("/"):
        if not chunk:
            raise ConfigError(f"{text!r}: one `/` separates the chunks of a prefix")
        if chunk.startswith("@"):
            raise ConfigError(f"{text!r}: chunks with @ are reserved for the gateway: remove the @")
        if wild := next((letter for letter in "*$?#" if letter in chunk), None):
            raise ConfigError(f"{text!r} has {wild}, a wildcard of Zenoh: remove it")
    return name(text, slashes=True)


def endpoint(text: object) -> str:
    """Parses a Zenoh endpoint: `tcp/127.0.0.1:7447`."""
    found = _matching(_ENDPOINT, text, "is no Zenoh endpoint: write tcp/127.0.0.1:7447")
    check_address(found)
    return found


def check_address(endpoint: str) -> None:
    """Raises `ConfigError` for an endpoint that Zenoh cannot use."""
    protocol, slash, address = endpoint.partition("/")
    if not slash or not address:
        raise ConfigError(f"{endpoint!r}: write it as tcp/127.0.0.1:7447")
    if protocol not in (*_WITH_PORT, "unixsock-stream"):
        raise ConfigError(f"{endpoint!r}: {protocol} is none of {', '.join(_WITH_PORT)}")
    if protocol == "unixsock-stream":
        return
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ConfigError(f"{endpoint!r}: write it as {protocol}/host:port")


def once(endpoints: list[str]) -> list[str]:
    for number, endpoint in enumerate(endpoints):
        if endpoint in endpoints[:number]:
            raise ConfigError(f"{endpoint} is there twice")
    return endpoints


def web_address(text: object) -> tuple[str, int]:
    """Parses `127.0.0.1:8080` as host and port."""
    match = _WEB.match(text) if isinstance(text, str) else None
    if match is None or not 1 <= int(match[2]) <= 65535:
        raise ConfigError(f"{shown(text)} is no address to listen on: write 127.0.0.1:8080")
    return match[1].strip("[]"), int(match[2])


def local_address(text: object) -> str:
    """Parses an address of this computer, such as `10.1.0.5`."""
    try:
        return str(ip_address(text if isinstance(text, str) else ""))
    except ValueError:
        raise ConfigError(f"{shown(text)} is no address of this computer: write 10.1.0.5") from None


def origin(text: object) -> str:
    """Parses `https://hmi.plant`, as a browser names the place of a page."""
    write = "write https://hmi.plant or http://10.0.0.5:3000, without a path"
    return _matching(_ORIGIN, text, f"is no origin: {write}").lower()


def host_name(text: object) -> str:
    """Parses `gateway.plant`, the name of a machine, in lower case."""
    wrong = "is no name of a machine: write gateway.plant, without a port"
    return _matching(_HOST_NAME, text, wrong).lower()


def every_digit(written: object, as_float: Callable[[object], float]) -> float:
    """Returns an integer of at most 64 bits as an integer, if a float would change it."""
    number = as_float(written)
    if not isinstance(written, int) or written == number:
        return number
    if not -(2**63) <= written < 2**64:
        raise ConfigError(f"{written} has more digits than the gateway keeps")
    return written


def not_negative(value: float) -> float:
    if not 0 <= value < math.inf:
        raise ValueError(f"{value:.15g} is no distance: it is zero or more")
    return value


def scale(factor: float) -> float:
    if factor == 0:
        raise ConfigError("a scale of 0 makes every value the same")
    return factor


def port(text: object) -> PortAddress:
    text = _text(text)
    if text.startswith(MODEM):
        port(text.removeprefix(MODEM))
        return parse_port(text)
    if match := _SERVER.match(text):
        host = match[1] or "host"
        raise ConfigError(f"{text} is no port: for a device server write tcp://{host}:{match[2]}")
    if _HOST.match(text):
        raise ConfigError(f"{text} is no port: write tcp://{text}:4001, with its port number")
    found = parse_port(text)
    if isinstance(found, SerialPath) and not is_name(found.path):
        raise ConfigError(f"{text!r} is no port: no file can have this name")
    if isinstance(found, SerialPath) and "/" not in text:
        if _WINDOWS.match(text):
            raise ConfigError(f"{text} is a port of Windows: here it is a path like /dev/ttyUSB0")
        raise ConfigError(f"{text} is no port: did you mean /dev/{text}?")
    return found


def sent_bytes(text: object) -> bytes:
    """Parses what a device server sends by itself, such as `DTU-0042<CR>`."""
    found = octets(_text(text))
    if not 1 <= len(found) <= LONGEST_REGISTRATION:
        raise ConfigError(f"{shown(text)} has {len(found)} bytes: write 1..{LONGEST_REGISTRATION}")
    return found


def networks(value: object) -> tuple[IPv4Network | IPv6Network, ...]:
    """Parses a list of addresses and networks, such as `[10.1.0.0/16, 192.0.2.7]`."""
    found = list[IPv4Network | IPv6Network]()
    for text in value if isinstance(value, list) else [value]:
        try:
            found.append(ip_network(text if isinstance(text, str) else ""))
        except ValueError:
            raise ConfigError(
                f"{shown(text)} is no network: write [10.1.0.0/16, 192.0.2.7]"
            ) from None
    if not found:
        raise ConfigError("no network: write [10.1.0.0/16, 192.0.2.7], or remove `allow`")
    return tuple(found)


def baudrate(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ConfigError(f"{shown(value)} is no baud rate: write a number such as 9600")
    if value not in BAUDRATES:
        near = min(BAUDRATES, key=lambda rate: abs(rate - value))
        raise ConfigError(f"{shown(value)} is no baud rate of serial ports; the nearest is {near}")
    return value


def serial_format(text: object) -> str:
    """Parses `7E1`: data bits, parity, stop bits."""
    write = "write data bits (7 or 8), parity (N, E or O) and stop bits (1 or 2), such as 7E1"
    return _matching(_FORMAT, text, f"is no character format: {write}")


def value_type(text: object) -> ValueType:
    return parse_type(_text(text))


def blocks(value: object) -> bool | Literal["only"]:
    if value is True or value is False:
        return value
    if value == "only":
        return "only"
    raise ConfigError(f"{shown(value)} is not known: use true, false or only")


def identity(value: object) -> dict[str, str]:
    """Parses `{vendor: ABB, serial: "1234"}`."""
    if not isinstance(value, dict) or not value:
        raise ConfigError(f'{shown(value)}: write what it tells, such as {{serial: "1234"}}')
    for name, text in value.items():
        if not isinstance(text, str) or not text.strip():
            raise ConfigError(f"{name}: {shown(text)} is no text: write numbers in quotes")
    return {str(name): text.strip() for name, text in value.items()}


def path(text: object) -> Path:
    if not isinstance(text, str) or not text.strip() or not is_name(text):
        raise ConfigError(f"{shown(text)} is no file name")
    return Path(text)


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise ConfigError(f"{shown(value)} is no text")
    return value


def _matching(rule: re.Pattern[str], text: object, wrong: str) -> str:
    if not isinstance(text, str) or not rule.match(text):
        raise ConfigError(f"{shown(text)} {wrong}")
    return text


def _lettered(letter: str) -> bool:
    # Marks (M) are part of letters in many scripts: Thai, Hindi, Arabic.
    return letter.isalnum() or unicodedata.category(letter).startswith("M")


def _spelt(letter: str) -> str:
    return {" ": "a space", "\t": "a tab", "/": "a `/`"}.get(letter, repr(letter))
