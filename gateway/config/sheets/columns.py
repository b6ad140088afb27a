"""Finds the columns of a sheet by their titles, in any order and in the usual spellings."""

import re
import unicodedata
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches

# Titles of each setting: English, German, Chinese (traditional and simplified), and the titles of
# exports of PLC programs. Of several columns with texts the one that stands first here counts.
_TITLES = {
    "name": "name, tag name, tagname, tag, label, label name, variable, variable name, symbol, "
    "signal, point, point name, signal name, "
    "variablenname, bezeichner, signalname, "
    "名稱, 名称, 標籤名稱, 标签名称, 標籤, 标签, "
    "變數名稱, 变量名称, 變量名稱, 变量名, 變數, 变量, 點名, 点名",
    "address": "address, addr, adr, register, plc address, register address, modbus address, "
    "operand, "
    "device number, assign device label, "
    "adresse, sps adresse, registeradresse, "
    "位址, 地址, 元件, 元件編號, 元件编号, 軟元件, 软元件, 裝置位址, "
    "寄存器, 寄存器地址, 暫存器, 暫存器位址",
    "type": "type, data type, datatype, typ, datentyp, datenformat, "
    "類型, 类型, 資料類型, 数据类型, 資料型別, 資料型態, 數據類型",
    "unit": "unit, units, eng unit, eng units, engineering unit, engineering units, uom, "
    "einheit, 單位, 单位",
    "scale": "scale, factor, multiplier, gain, scaling factor, scale factor, "
    "faktor, skalierung, skalierungsfaktor, multiplikator, 比例, 倍率, 係數, 系数, "
    "比例係數, 比例系数",
    "offset": "offset, versatz, nullpunkt, 偏移, 偏移量",
    "description": "description, comment, comments, remark, remarks, note, notes, device comment, "
    "beschreibung, kommentar, bemerkung, bemerkungen, hinweis, "
    "註解, 注解, 註釋, 注释, 說明, 说明, 描述, 備註, 备注",
    "write": "write, writable, writeable, r w, rw, read write, access, access rights, "
    "client access, permission, schreiben, schreibbar, zugriff, lesen schreiben, l s, "
    "讀寫, 读写, 可寫, 可写, 存取, 權限, 权限, 訪問權限, 访问权限",
    "every": "every, interval, scan rate, scan, scan time, poll, poll rate, poll interval, "
    "polling, polling interval, cycle, cycle time, update rate, "
    "intervall, abtastung, abtastrate, abtastzeit, zyklus, zykluszeit, abfrageintervall, "
    "週期, 周期, 掃描週期, 扫描周期, 採樣週期, 采样周期, 採集週期, 采集周期",
    "deadband": "deadband, dead band, hysteresis, totband, totzone, hysterese, 死區, 死区",
    "min": "min, minimum, lower limit, low limit, write min, untergrenze, 最小值, 下限",
    "max": "max, maximum, upper limit, high limit, write max, obergrenze, 最大值, 上限",
    "verify": "verify, read back, prüfen, rücklesen",
    "history": "history, archive, historie, archiv, archivieren, 歷史, 历史, 記錄, 记录",
    "word_order": "word order, wordorder, word swap, wortreihenfolge, wortfolge",
    "byte_order": "byte order, byteorder, byte swap, bytereihenfolge, bytefolge",
    "length": "length, string length, chars, characters, länge, zeichen, 長度, 长度",
    "device": "device, device name, plc, station name, gerät, steuerung, 設備, 设备, 裝置, 装置",
    "raw_low": "raw low, raw min, raw lo, rohwert min, rohwert von",
    "raw_high": "raw high, raw max, raw hi, rohwert max, rohwert bis",
    "scaled_low": "scaled low, scaled min, eng low, eng min, eu min, eu low, messbereich von",
    "scaled_high": "scaled high, scaled max, eng high, eng max, eu max, eu high, messbereich bis",
    "scaling": "scaling",
    "enum": "enum, states, state names, value names, zustände, zustandsnamen, 狀態名稱, 状态名称",
    "invert": "invert, inverted, invertiert",
    "computed": "computed",
    "bit": "bit, bit no, bit number, bitnummer, bit nr, 位元, 位號, 位号",
    # Columns that change a value or its source, in a way that no setting has: see `UNUSABLE`.
    "divisor": "divisor, divide, divide by, divider, teiler, 除數, 除数",
    "places": "decimal places, decimal point, decimal position, kommastellen, nachkommastellen, "
    "dezimalstellen, 小數位數, 小数位数, 小數點, 小数点",
    "negate": "negate value, negate, negiert",
    "sign": "signed, unsigned, sign, vorzeichen",
    "station": "station, station no, station number, slave, slave id, unit id, node, node id, "
    "stationsnummer, 站號, 站号",
    # Columns of an export of the gateway that only inform.
    "": "key, write key, value type, raw type",
}
# Left out, these would give wrong values that look right.
UNUSABLE = {
    "divisor": "write the factor into a column Scale: 0.1 instead of 10",
    "places": "write the factor into a column Scale: 0.1 instead of 1 place",
    "negate": "write a negative Scale, or correct the PLC",
    "sign": "write int16 or uint16 into a column Type",
    "station": "the sheet has several stations: write their names into a column Device",
}
_NO = {"", "0", "no", "none", "false", "nein", "falsch", "-"}
# Cells that change nothing; of stations, one is allowed.
_NEUTRAL = {"divisor": {"", "1", "1,0", "1.0"}, "places": {"", "0"}, "negate": _NO, "sign": {""}}
_TEXTS = ("name", "description")  # a second column for these is left out, not refused
# Without another column of addresses this one has them: `Device` is the maker's word for D100.
_ADDRESS_TOO = ("device", "device name", "裝置", "装置")
# A program with this title writes its scan rates in ms.
_IN_MILLISECONDS = ("client access",)
_BRACKETS = re.compile(r"[\[(（]([^\])）]*)[\])）]\s*\Z")
_SEPARATORS = re.compile(r"[\s_\-./\\:()\[\]（）]+")
_UNITS = {
    "ms": "ms",
    "msec": "ms",
    "毫秒": "ms",
    "s": "s",
    "sec": "s",
    "sek": "s",
    "秒": "s",
    "min": "min",
}
_KNOWN = {
    title.strip(): setting for setting, titles in _TITLES.items() for title in titles.split(",")
}
_RANK = {title: rank for rank, title in enumerate(_KNOWN)}


@dataclass(frozen=True, slots=True)
class Column:
    """A column with a known title. `title` is as written, `index` counts from 0."""

    setting: str
    title: str
    index: int
    unit: str = ""  # in brackets of the title: Interval [ms]

    @property
    def place(self) -> str:
        return f"column {letter(self.index)} ({self.title})"


@dataclass(slots=True)
class Columns:
    """The columns of a sheet by setting, the titles that are not used, and mistakes by index."""

    by_setting: dict[str, Column] = field(default_factory=dict)
    unused: list[str] = field(default_factory=list)
    mistakes: list[tuple[int, str]] = field(default_factory=list)


def titles_in(cells: Sequence[str]) -> int:
    """Returns the number of cells that are known titles; 0 for a row that cannot be the titles."""
    found = {setting for cell in cells if (setting := _setting(cell, ())[0])}
    return len(found) if len(found) > 1 else 0


def columns_of(cells: Sequence[str], others: Sequence[str]) -> Columns:
    """Returns the columns of the row of titles. `others`: more settings, by their own names."""
    found = Columns()
    ranked = []
    for index, cell in enumerate(cells):
        setting, unit = _setting(cell, others)
        if setting:
            rank = _RANK.get(_plain(cell), len(_RANK))
            ranked.append((rank, Column(setting, cell, index, unit)))
        elif setting is None and cell:
            _note_unknown(found, index, cell, others)
    for _, column in sorted(ranked, key=lambda one: (one[0], one[1].index)):
        first = found.by_setting.setdefault(column.setting, column)
        if first is not column and column.setting in _TEXTS:
            found.unused.append(column.title)
        elif first is not column:
            both = f"{first.place} has the same meaning: delete or rename one of them"
            found.mistakes.append((column.index, both))
    named = found.by_setting.get("device")
    if "address" not in found.by_setting and named and _plain(named.title) in _ADDRESS_TOO:
        found.by_setting["address"] = replace(named, setting="address")
        del found.by_setting["device"]
    every = found.by_setting.get("every")
    if every and not every.unit and any(_plain(cell) in _IN_MILLISECONDS for cell in cells):
        found.by_setting["every"] = replace(every, unit="ms")
    return found


def _note_unknown(found: Columns, index: int, title: str, others: Sequence[str]) -> None:
    """A title that is nearly known is a mistake: a misspelt `Scale` would change every value."""
    close = get_close_matches(_plain(title), [*_KNOWN, *others], n=1, cutoff=0.8)
    if close:
        setting = _KNOWN.get(close[0], close[0])
        known = next((title for title, one in _KNOWN.items() if one == setting), setting)
        found.mistakes.append((index, f"no column of tags: did you mean {known.capitalize()}?"))
    else:
        found.unused.append(title)


def _setting(title: str, others: Sequence[str]) -> tuple[str | None, str]:
    """Returns the setting of a title, and its unit; "" for a column that only informs."""
    plain = _plain(title)
    if plain in _KNOWN:
        return _KNOWN[plain], ""
    if (name := plain.replace(" ", "_")) in others:
        return name, ""
    if match := _BRACKETS.search(title):
        setting = _KNOWN.get(_plain(title[: match.start()]))
        return setting, _UNITS.get(match[1].strip().casefold(), "")
    return None, ""


def _plain(title: str) -> str:
    text = unicodedata.normalize("NFKC", title).casefold()
    return _SEPARATORS.sub(" ", text).strip(" *#")


def unusable(setting: str, cells: Collection[str]) -> str:
    """Returns why a column of `UNUSABLE` cannot be left out; empty if its cells change nothing."""
    found = {cell.casefold() for cell in cells}
    changes = len(found) > 1 if setting == "station" else bool(found - _NEUTRAL[setting])
    return f"this column cannot be used: {UNUSABLE[setting]}" if changes else ""


def letter(index: int) -> str:
    """Returns the letter of a column, as a spreadsheet shows it: A, B … AA."""
    text = ""
    index += 1
    while index:
        index, rest = divmod(index - 1, 26)
        text = chr(ord("A") + rest) + text
    return text
