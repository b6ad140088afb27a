"""Cells as settings: numbers with a point or a comma, switches, types, durations.

Each function raises `ConfigError` with what would be right. A text that may still be right
(`500ms`, a type) is returned as the configuration writes it, and checked there.
"""

import re
import unicodedata
from collections.abc import Iterable

from gateway.errors import ConfigError

_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:[.,][0-9]*)?|[.,][0-9]+)(?:[eE][-+]?[0-9]+)?\Z")
# 1.000 and 1,000: a point or a comma, and both a decimal mark and one between thousands.
_AMBIGUOUS = re.compile(r"[-+]?[1-9][0-9]{0,2}([.,])[0-9]{3}\Z")
_DECIMAL = re.compile(r"[-+]?[0-9]*([.,])[0-9]+(?:[eE][-+]?[0-9]+)?\Z")
_THOUSANDS = re.compile(
    r"([-+]?[1-9][0-9]{0,2}(?:(?P<mark>[., '’])[0-9]{3})(?:(?P=mark)[0-9]{3})*)([.,][0-9]+)?\Z"
)
_TIME = re.compile(r"([0-9]+(?:[.,][0-9]+)?) ?([^\d\s.,]+)\Z")
_TIMES = {
    **dict.fromkeys(("ms", "msec", "msek", "毫秒"), "ms"),
    **dict.fromkeys(("s", "sec", "sek", "second", "seconds", "sekunde", "sekunden", "秒"), "s"),
    **dict.fromkeys(("min", "minute", "minutes", "minuten", "分", "分鐘", "分钟"), "min"),
    **dict.fromkeys(("h", "hour", "hours", "std", "stunde", "stunden", "小時", "小时"), "h"),
}
_YES = "true, yes, y, x, on, 1, ja, j, wahr, ein, ✓, ✔, 是, 真, 對, 对"
_NO = "false, no, n, off, 0, nein, falsch, aus, -, 否, 假"
_FLAGS = {
    **dict.fromkeys(_YES.split(", "), True),
    **dict.fromkeys(_NO.split(", "), False),
}
_WRITE = (
    "rw, wr, w, write, read write, readwrite, read and write, writable, writeable, wo, "
    "write only, ls, sl, schreiben, lesen schreiben, lesen und schreiben, schreibbar, "
    "讀寫, 读写, 可讀寫, 可读写, 寫, 写, 可寫, 可写"
)
_READ = "r, ro, read, read only, readonly, l, lesen, nur lesen, 唯讀, 只读, 只讀, 讀, 读"
_ACCESS = {
    **_FLAGS,
    **dict.fromkeys(_WRITE.split(", "), True),
    **dict.fromkeys(_READ.split(", "), False),
}
_TYPES = {
    "bool": "bool boolean bit digital binary binär bits 位 位元 開關 开关",
    "int16": "int16 short int sint16 s16 i16 int16signed signed signed16 signedword word[signed] "
    "wordsigned 16bitsigned int16s",
    "uint16": "uint16 word ushort uint u16 unsigned unsigned16 unsignedword word[unsigned] "
    "word[unsigned]/bitstring[16-bit] wordunsigned unsignedshort 16bitunsigned",
    "int32": "int32 dint long s32 i32 sint32 signedlong doubleword[signed] doublewordsigned "
    "32bitsigned",
    "uint32": "uint32 dword udint ulong u32 unsignedlong doubleword doubleword[unsigned] "
    "doubleword[unsigned]/bitstring[32-bit] 32bitunsigned",
    "int64": "int64 lint llong s64 i64",
    "uint64": "uint64 ulint qword lword u64",
    "float32": "float32 float real single f32 float[singleprecision] singlefloat gleitkomma "
    "浮點 浮点 浮點數 浮点数 實數 实数",
    "float64": "float64 double lreal f64 float[doubleprecision]",
    "bcd16": "bcd16 bcd",
    "bcd32": "bcd32 lbcd",
    "telephone": "telephone",
    "": "default standard",
}
_KINDS = {spelling: kind for kind, row in _TYPES.items() for spelling in row.split()}
_STRING = re.compile(r"(?:string|text|char|字串|字符串)\[?([0-9]*)\]?\Z")
# `WORD[50]`, and `ARRAY[0..49] OF WORD` as IEC 61131 writes it
_ARRAY = re.compile(
    r"(?:array\[(?P<first>[0-9]{1,5})\.\.(?P<last>[0-9]{1,5})\]of)?"
    r"(?P<kind>[^\[]+)(?(first)|\[(?P<count>[0-9]{1,5})\])\Z"
)
_ORDERS = {
    **dict.fromkeys(("low first", "low", "little", "little endian"), "low_first"),
    **dict.fromkeys(("high first", "high", "big", "big endian"), "high_first"),
}
_NAMED = re.compile(r"(-?[0-9]+)\s*[=:]\s*(['\"]?)(\S.*?)\2\Z")
_SPREADSHEET_ERROR = re.compile(
    r"#(REF|BEZUG|N/A|NV|NAME|VALUE|WERT|DIV/0|NUM|ZAHL|NULL)[!?]?\Z", re.IGNORECASE
)


def check(text: str) -> None:
    """Raises `ConfigError` for the error of a formula."""
    if _SPREADSHEET_ERROR.match(text):
        raise ConfigError(f"{text} is the error of a formula: correct it in the spreadsheet")


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
    known = _FLAGS.get(_plain(text))
    if known is None:
        raise ConfigError(f"{text!r} is neither yes nor no")
    return known


def access(text: str) -> bool:
    """Returns True for `R/W`, `write`, `yes`."""
    known = _ACCESS.get(_plain(text), _ACCESS.get(_plain(text).replace(" ", "")))
    if known is None:
        raise ConfigError(f"{text!r} is no access: write R or R/W")
    return known


def kind(text: str, length: str) -> str | None:
    """Returns the type as the configuration writes it; None for `default`."""
    plain = unicodedata.normalize("NFKC", text).casefold().replace("(", "[").replace(")", "]")
    plain = re.sub(r"[\s_]+", "", plain)
    if match := _STRING.match(plain):
        count = match[1] or length
        if not count:
            raise ConfigError(f"{text} has no length: write {text}[16], or add a column Length")
        return f"string[{count}]"
    if (match := _ARRAY.match(plain)) and match["kind"] in _KINDS:
        first, last, count = match["first"], match["last"], match["count"]
        return f"{_KINDS[match['kind']]}[{count or int(last) - int(first) + 1}]"
    return _KINDS.get(plain, text) or None


def duration(text: str, unit: str) -> str | int | float:
    """Returns `500 ms`, `0,5s`, `1 Sek` as durations. `unit`: of a number alone, if known."""
    if match := _TIME.match(text):
        return match[1].replace(",", ".") + _TIMES.get(match[2].casefold(), match[2])
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
    return _ORDERS.get(_plain(text), text)


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
