"""The `write` command: writes one tag, or several of a device, and prints the outcome."""

import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import orjson
import typer

from gateway.cli import completion
from gateway.cli.client import connected, parse_value, suggestion, tags_by_key
from gateway.cli.progress import loaded
from gateway.cli.tables import value_text
from gateway.cli.terminal import FAILED, USER_MISTAKE, AsJson, ConfigPath, Direct, err, printable
from gateway.config import Config
from gateway.contract import payload
from gateway.contract.problems import Problem
from gateway.errors import BadValue, ConfigError, GatewayError
from gateway.tags import Tag
from gateway.values import Kind, Value

_SWITCH: dict[str, Value] = {"on": True, "off": False}
_USER_MISTAKES = {Problem.BAD_VALUE, Problem.NOT_WRITABLE, Problem.UNKNOWN_TAG}


def write(
    config: ConfigPath,
    tag: Annotated[
        str,
        typer.Argument(
            metavar="TAG",
            help="device/tag; a device for several",
            autocompletion=completion.tags,
        ),
    ],
    values: Annotated[
        list[str],
        typer.Argument(
            metavar="VALUE",
            help="JSON: true, 12.5, AB; on and off for bits. Of a device: tag=value ...",
        ),
    ],
    without_gateway: Direct = False,
    as_json: AsJson = False,
) -> None:
    """Write one tag, or several tags of a device, and print the reply of the PLC."""
    plant = loaded(config)
    known = tags_by_key(plant)
    if any(device.name == tag for device in plant.devices):
        group = _group(config, known, tag, values)
        answer = _write(plant, tag, group, directly=without_gateway)
        lines = _group_lines(tag, answer)
    else:
        if len(values) > 1:
            raise ConfigError(f"{tag} takes one value; for several tags name their device")
        value = _value(config, known, tag, values[0])
        answer = _write(plant, tag, {known[tag]: value}, directly=without_gateway)
        lines = [(tag, answer)]
    if as_json:
        print(json.dumps(answer))
    else:
        served = {one.name for one in plant.devices if one.served}
        for key, end in lines:
            if "error" in end:
                err.print(outcome(key, end), style="red")
            else:
                print(outcome(key, end, held=key.partition("/")[0] in served))
    if "error" in answer:
        sys.exit(error_code(answer))


def _group(
    config: Path, known: Mapping[str, Tag], device: str, texts: Sequence[str]
) -> dict[Tag, Value]:
    """Returns the values by tag. Raises `ConfigError` with every mistake."""
    group, mistakes = dict[Tag, Value](), list[str]()
    for text in texts:
        name, is_pair, value = text.partition("=")
        if not is_pair:
            mistakes.append(f"{text} is no tag=value, as in {device} recipe/a=1 recipe/b=2")
        elif known.get(f"{device}/{name}") in group:
            mistakes.append(f"{device}/{name} is named twice")
        else:
            try:
                parsed = _value(config, known, f"{device}/{name}", value)
                group[known[f"{device}/{name}"]] = parsed
            except (ConfigError, BadValue) as error:
                mistakes.append(str(error))
    if mistakes:
        raise ConfigError("\n".join(mistakes))
    return group


def _value(config: Path, known: Mapping[str, Tag], name: str, text: str) -> Value:
    """Returns the value that the text means for the tag. Raises `ConfigError`, `BadValue`."""
    target = known.get(name)
    if target is None:
        raise ConfigError(f"there is no tag {name} in {config}{suggestion(name, known)}")
    if target.write is None:
        if target.origin.inputs:
            raise ConfigError(f"{name} cannot be written: its value follows from other reads")
        raise ConfigError(f"{name} cannot be written: it has no `write: true` in {config}")
    parsed = _parsed(text, target)
    try:
        target.encode(parsed)
    except BadValue as error:
        raise BadValue(f"{name}: {error}") from None
    return parsed


def _write(
    config: Config, target: str, values: Mapping[Tag, Value], *, directly: bool
) -> dict[str, object]:
    """Writes one tag, or several of the device `target`. Returns the outcome in the words of a
    gateway."""
    is_group = target not in {tag.key for tag in values}
    if not directly:
        with connected(config, err.print) as client:
            if not is_group:
                [value] = values.values()
                return client.requests.write(target, value)
            by_name = {tag.name: value for tag, value in values.items()}
            return client.requests.write(target, by_name)
    from gateway.cli.line import direct

    direct.alone(config)
    started = time.monotonic()
    try:
        ends = direct.run(direct.write_group(config, [*values.items()]))
    except GatewayError as error:
        return _decoded(payload.outcome(payload.failure(error)))
    results = {
        tag.name: payload.failure(end) if isinstance(end, GatewayError) else end
        for tag, end in zip(values, ends, strict=True)
    }
    if is_group:
        return _decoded(payload.outcome(payload.GroupResult(results, time.monotonic() - started)))
    [result] = results.values()
    return _decoded(payload.outcome(result))


def _group_lines(device: str, answer: dict[str, object]) -> list[tuple[str, dict[str, object]]]:
    """Returns each tag with its outcome, or the one of the whole."""
    tags = answer.get("tags")
    if not isinstance(tags, dict):
        return [(device, answer)]
    return [(f"{device}/{name}", end) for name, end in tags.items()]


def _parsed(text: str, tag: Tag) -> Value:
    """Returns the value that the text means for this tag."""
    if tag.shaping.names is not None and text in tag.shaping.names.by_number.values():
        return text  # `on` is a name here
    kind, parsed = tag.layout.type, parse_value(text)
    if kind.kind is Kind.BOOL and text.lower() in _SWITCH and tag.element is None:
        return _SWITCH[text.lower()]
    if kind.is_text and not isinstance(parsed, str):
        return text  # 12 is a text for this tag
    return parsed


def _decoded(encoded: bytes) -> dict[str, object]:
    answer: dict[str, object] = orjson.loads(encoded)
    return answer


def error_code(answer: dict[str, object]) -> int:
    """Returns the exit code for a failed write or command."""
    return USER_MISTAKE if answer["error"] in _USER_MISTAKES else FAILED


def outcome(target: str, answer: dict[str, object], *, held: bool = False) -> str:
    """Describes the outcome of a write or command in one line.

    `held`: the gateway keeps the value for the master of a served line.
    """
    if "error" in answer:
        code = f" {answer['code']}" if answer.get("code") else ""
        return printable(f"{target}: {answer['error']}{code}: {answer.get('reason')}")
    took = f"{float(str(answer['took'])) * 1000:.0f} ms"
    how = "acknowledged by the PLC"
    if held:
        how = "held for the master of the line"
    elif answer.get("verified"):
        how = "acknowledged and read back"
    elif answer.get("acknowledged") is False:
        how = "broadcast, without acknowledgement"
    note = f"; {answer['note']}" if "note" in answer else ""
    how += f" ({answer['origin']})" if answer.get("origin") else ""
    return printable(f"{target} = {value_text(answer['value'])}: {how}, {took}{note}")
