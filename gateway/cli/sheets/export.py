"""The `export` command: all tags as a sheet, for SCADA programs, for people, and for `import`."""

import csv
import io
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import orjson
import typer

from gateway.cli.client import matches, wanted_keys
from gateway.cli.progress import loaded
from gateway.cli.terminal import AsJson, ConfigPath, TagNames
from gateway.config.sheets import neutral
from gateway.config.transfers.ranges import is_range
from gateway.contract.meta import meta_fields
from gateway.errors import ConfigError
from gateway.protocols.driver import Unit
from gateway.tags import Tag
from gateway.tags.tag import CounterRule
from gateway.values import BYTES, Kind

_FIRST = ("Device", "Name", "Address", "Type", "Unit", "Scale", "Offset", "Every", "R/W")
_OWN = {"type", "raw_type", "address", "unit", "scale", "offset", "every", "write", "deadband"}
_OWN |= {"clamp", "range", "enum", "counter", "length"}
_TIMES = {"every", "heartbeat", "debounce"}


def export(
    config: ConfigPath,
    tags: TagNames = None,
    output: Annotated[
        Path | None, typer.Option(help="The CSV file to write (default: print it)")
    ] = None,
    decimal_comma: Annotated[
        bool, typer.Option("--decimal-comma", help="0,1 and ; as German or French Excel reads it")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Export tags as a sheet: keys, types, units and limits, as `@meta` has them."""
    plant = loaded(config)
    wanted = wanted_keys(plant, tags)
    ranges = {rule.source for rule in plant.transfers if is_range(rule.text[0])}
    found = [
        tag
        for device in plant.devices
        for tag in device.tags
        if matches(tag.key, wanted) and tag.key not in ranges
    ]
    if as_json:
        text = "".join(f"{json.dumps({'tag': one.key, **meta_fields(one)})}\n" for one in found)
    else:
        rows = [_row(plant.zenoh.prefix, one) for one in found]
        text = table(rows, decimal_comma=decimal_comma)
    if output is None:
        sys.stdout.write(text)
        return
    try:
        # With the mark Excel shows °C.
        output.write_bytes(text.encode("utf-8" if as_json else "utf-8-sig"))
    except OSError as error:
        raise ConfigError(f"{output} cannot be written: {error.strerror}") from None
    print(f"{output}: {len(found)} tags of {config}")


def table(rows: list[dict[str, object]], *, decimal_comma: bool) -> str:
    """Returns rows as CSV; a column that no tag uses is left out, but for the first ones."""
    used = dict.fromkeys(title for row in rows for title, cell in row.items() if cell != "")
    titles = [*_FIRST, *(title for title in used if title not in _FIRST)]
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, delimiter=";" if decimal_comma else ",")
    writer.writerow(titles)
    for row in rows:
        writer.writerow([_cell(row.get(title, ""), decimal_comma) for title in titles])
    return stream.getvalue()


def _row(prefix: str, tag: Tag) -> dict[str, object]:
    meta = meta_fields(tag)
    rule, band = meta["write"], meta["deadband"]
    limits = rule if isinstance(rule, dict) else {}
    row: dict[str, object] = {
        "Device": tag.device,
        "Name": tag.name,
        "Address": tag.text,
        "Type": _type(tag),
        "Unit": tag.label.unit,
        "Scale": "" if tag.shaping.scale == 1 else tag.shaping.scale,
        "Offset": "" if tag.shaping.offset == 0 else tag.shaping.offset,
        "Every": _time(tag.every),
        "R/W": "R" if rule is None else "R/W",
        "Min": _or_empty(limits.get("min")),
        "Max": _or_empty(limits.get("max")),
        "Verify": "yes" if limits.get("verify") else "",
        "Deadband": f"{band['amount']:.15g}{'%' * band['percent']}"
        if isinstance(band, dict)
        else "",
    }
    row |= _order(tag)
    for title, bounds in (("Clamp", tag.shaping.clamp), ("Range", tag.shaping.range)):
        if bounds is not None:
            row[title] = orjson.dumps([*bounds]).decode()
    if isinstance(tag.origin.kept, CounterRule):
        row["Counter"] = _counter(tag.origin.kept)
    if tag.shaping.names is not None:
        row["Enum"] = ";".join(
            f"{number}={name}" for number, name in tag.shaping.names.by_number.items()
        )
    for name, value in meta.items():
        if name not in _OWN:
            row[name.replace("_", " ").capitalize()] = _other(name, value)
    row["Value type"] = meta["type"]
    row["Key"] = f"{prefix}/{tag.key}"
    row["Write key"] = f"{prefix}/{tag.key}/@set" if rule is not None else ""
    return row


def _type(tag: Tag) -> str:
    """Returns the type in the device; nothing where the file has none."""
    if tag.origin.formula is not None or tag.origin.shape is not None:
        return ""
    return str(meta_fields(tag)["raw_type"])


def _counter(rule: CounterRule) -> str:
    """Returns a counter as `import` takes it."""
    bits = rule.modulus.bit_length() - 1
    width = f"bits: {bits}" if rule.modulus == 1 << bits else f"top: {rule.modulus - 1}"
    return f"{{{width}, most: {rule.most}}}"


def _order(tag: Tag) -> Mapping[str, object]:
    """Returns the order of words and bytes, where the type has one."""
    if tag.origin.kept is not None:
        return _order(tag.origin.inputs[0])
    kind = tag.layout.type
    if (
        tag.origin.formula is not None
        or tag.origin.shape is not None
        or tag.unit_kind is not Unit.WORD
        or kind.kind is Kind.BOOL
    ):
        return {}
    if kind.kind in BYTES:
        return {"Byte": tag.layout.byte.value}
    found = {"Byte order": tag.layout.byte_order.value}
    if kind.is_number and kind.element.words > 1:
        found["Word order"] = tag.layout.word_order.value
    return found


def _other(name: str, value: object) -> object:
    """Returns a setting that `@meta` has; the usual ones are left out."""
    if value in (None, False, "", "change", "json"):
        return ""
    if name in _TIMES and isinstance(value, float):
        return _time(value)
    return orjson.dumps(value).decode() if isinstance(value, (dict, list, tuple)) else value


def _time(seconds: float) -> str:
    return f"{seconds:.15g}s" if seconds.is_integer() else f"{seconds * 1000:.10g}ms"


def _or_empty(value: object) -> object:
    return "" if value is None else value


def _cell(value: object, decimal_comma: bool) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.15g}".replace(".", ",") if decimal_comma else f"{value:.15g}"
    return neutral(value) if isinstance(value, str) else str(value)
