"""Cells as settings: numbers with a point or a comma, switches, types, durations.

Each function raises `ConfigError` with what would be right. A text that may still be right
(`500ms`, a type) is returned as the configuration writes it, and checked there.
"""

import re
import unicodedata
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from gateway.errors import ConfigError
from gateway.values.numerals import nanoseconds

_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:[.,][0-9]*)?|[.,][0-9]+)(?:[eE][-+]?[0-9]+)?\Z")
# 1.000 and 1,000: a point or a comma, and both a decimal mark and one between thousands.
_AMBIGUOUS = re.compile(r"[-+]?[1-9][0-9]{0,2}([.,])[0-9]{3}\Z")
_DECIMAL = re.compile(r"[-+]?[0-9]*([.,])[0-9]+(?:[eE][-+]?[0-9]+)?\Z")
_THOUSANDS = re.compile(
    r"([-+]?[1-9][0-9]{0,2}(?:(?P<mark>[., '’])[0-9]{3})(?:(?P=mark)[0-9]{3})*)([.,][0-9]+)?\Z"
)
_TIME = re.compile(r"([0-9]+(?:[.,][0-9]+)?) ?([^\d\s.,]+)\Z")
_STRING = re.compile(r"(?:string|text|char|字串|字符串)\[?([0-9]*)\]?\Z")
# `WORD[50]`, and `ARRAY[0..49] OF WORD` as IEC 61131 writes it
_ARRAY = re.compile(
    r"(?:array\[(?P<first>[0-9]{1,5})\.\.(?P<last>[0-9]{1,5})\]of)?"
    r"(?P<kind>[^\[]+)(?(first)|\[(?P<count>[0-9]{1,5})\])\Z"
)
_NAMED = re.compile(r"(-?[0-9]+)\s*[=:]\s*(['\"]?)(\S.*?)\2\Z")
_SPREADSHEET_ERROR = re.compile(
    r"(#(REF|BEZUG|N/A|NV|NAME|VALUE|WERT|DIV/0|NUM|ZAHL|NULL)[!?]?|Err:[0-9]+)\Z", re.IGNORECASE
)


@cache
def data(name: str) -> dict[str, Any]:
    """Returns the data of a file beside this one."""
    return dict(yaml.safe_load(Path(__file__).with_name(name).read_bytes()))


@cache
def words(section: str) -> dict[str, Any]:
    """Returns a section of words.yaml, the values by their words in the order of the file."""
    rows = data("words.yaml")[section].items()
    return {word: value for value, row in rows for word in row.split(", ")}


def check(text: str) -> str:
    """Returns a text. Raises `ConfigError` for the error of a formula."""
    if _SPREADSHEET_ERROR.match(text):
        raise ConfigError(f"{text} is the error of a formula: correct it in the spreadsheet")
    return text


def decimal_mark(numbers: Iterable[str]) -> str | None:
    """Returns the decimal mark of the numbers of a sheet; None where they do not tell."""
    marks = {
        match[1]
        for text in numbers
        if (match := _DECIMAL.match(text)) and not _AMBIGUOUS.match(text)
    }
    return marks.pop() if len(marks) == 1 else None


def number(text: str, decimal: str | None) -> int | float:
    """Returns `0,1`, `1E3`, `1.234,5` as numbers. `decimal`: the mark of this sheet, if known."""
    text = text.replace("\u2212", "-").replace("\xa0", " ")
    ambiguous = _AMBIGUOUS.match(text)
    if ambiguous and ambiguous[1] != decimal:
        if decimal is None:
            short = text.replace(ambiguous[1], "")
            raise ConfigError(f"{text} can mean {_tidy(text)} or {short}: write one of them")
        text = text.replace(ambiguous[1], "")
    elif not _NUMBER.match(text):
        match = _THOUSANDS.match(text)
        if match is None or (match[3] or "")[:1] == match["mark"]:
            raise ConfigError(f"{text!r} is no number")
        text = match[1].replace(match["mark"], "") + (match[3] or "")
    value = float(text.replace(",", "."))
    whole = re.fullmatch(r"[-+]?[0-9]{1,18}", text)
    return int(text) if whole else int(value) if value.is_integer() and abs(value) < 1e15 else value


def _tidy(text: str) -> str:
    return text.replace(",", ".").rstrip("0").rstrip(".")


def flag(text: str) -> bool:
    """Returns `yes`, `ja`, `WAHR`, `x`, `是` as True."""
    return _word(text, "neither yes nor no", "flags")


def access(text: str) -> bool:
    """Returns True for `R/W`, `write`, `yes`."""
    return _word(text, "no access: write R or R/W", "flags", "access")


def _word(text: str, what: str, *sections: str) -> bool:
    for spelling in (_plain(text), _plain(text).replace(" ", "")):
        for section in sections:
            if spelling in words(section):
                return bool(words(section)[spelling])
    raise ConfigError(f"{text!r} is {what}")


def kind(text: str, length: str) -> str | None:
    """Returns the type as the configuration writes it; None for `default`."""
    plain = unicodedata.normalize("NFKC", text).casefold().replace("(", "[").replace(")", "]")
    plain = re.sub(r"[\s_]+", "", plain)
    if match := _STRING.match(plain):
        count = match[1] or length
        if not count:
            raise ConfigError(f"{text} has no length: write {text}[16], or add a column Length")
        return f"string[{count}]"
    kinds = words("types")
    if (match := _ARRAY.match(plain)) and match["kind"] in kinds:
        first, last, count = match["first"], match["last"], match["count"]
        return f"{kinds[match['kind']]}[{count or int(last) - int(first) + 1}]"
    return kinds.get(plain, text) or None


def duration(text: str, unit: str) -> str | int | float:
    """Returns `500 ms`, `0,5s`, `1 Sek` as durations. `unit`: of a number alone, if known."""
    if nanoseconds(text) is not None:
        return text
    if match := _TIME.match(text):
        return match[1].replace(",", ".") + str(words("times").get(match[2].casefold(), match[2]))
    value = number(text, "." if "." in text else ",")
    return f"{value}{unit}" if unit else value


def deadband(text: str, decimal: str | None) -> str | int | float:
    """Returns `0,5` and `2 %`."""
    if text.endswith("%"):
        return f"{number(text[:-1].strip(), decimal)}%"
    return number(text, decimal)


def names(text: str) -> dict[str, str]:
    """Returns the names of numbers: `0=off;1=auto`, `0: off, 1: auto`."""
    found: dict[str, str] = {}
    for part in re.split(r"[;,|]", text.strip("{}")):
        match = _NAMED.match(part.strip())
        if match is None or match[1] in found:
            raise ConfigError(f"{text!r} does not name numbers: write 0=off;1=auto")
        found[match[1]] = match[3]
    return found


def order(text: str) -> str:
    return str(words("orders").get(_plain(text), text))


def address(text: str, bit: str) -> str:
    """Returns an address, with a bit of its word.

    A number that the spreadsheet wrote as 40101,0 loses its end.
    """
    if bit and not bit.isdecimal():
        raise ConfigError(f"{bit} is no number of a bit")
    return re.sub(r"\A([0-9]+),0+\Z", r"\1", text) + (f".{bit}" if bit else "")


def name(text: str) -> str:
    """Returns a text as the name of a tag: `_` takes the place of spaces and other characters."""
    composed = unicodedata.normalize("NFC", text)
    safe = "".join(letter if _in_names(letter) else " " for letter in composed)
    chunks = ("_".join(chunk.split()) for chunk in safe.split("/"))
    return "/".join(chunk for chunk in chunks if chunk)


def _in_names(letter: str) -> bool:
    return letter in "_-./" or letter.isalnum() or unicodedata.category(letter)[0] == "M"


def _plain(text: str) -> str:
    text = unicodedata.normalize("NFKC", text).casefold()
    return re.sub(r"[\s/\\+_&,;.-]+", " ", text).strip() or text.strip()
