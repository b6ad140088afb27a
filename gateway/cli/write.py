"""The `write` command: writes one tag and prints the outcome."""

import json
import sys
from typing import Annotated

import orjson
import typer

from gateway.cli.client import connected, parse_value, suggestion, tags_by_key
from gateway.cli.tables import value_text
from gateway.cli.terminal import FAILED, USER_MISTAKE, AsJson, ConfigPath, Direct, err, printable
from gateway.config import Config, load
from gateway.errors import BadValue, ConfigError, GatewayError
from gateway.northbound import payload
from gateway.northbound.payload import Problem
from gateway.tags import Tag
from gateway.values import Kind, Value

_SWITCH: dict[str, Value] = {"on": True, "off": False}
_USER_MISTAKES = {Problem.BAD_VALUE, Problem.NOT_WRITABLE, Problem.UNKNOWN_TAG}


def write(
    config: ConfigPath,
    tag: Annotated[str, typer.Argument(metavar="TAG", help="device/tag")],
    value: Annotated[
        str, typer.Argument(metavar="VALUE", help="JSON: true, 12.5, AB; on and off for bits")
    ],
    without_gateway: Direct = False,
    as_json: AsJson = False,
) -> None:
    """Write one tag and print the reply of the PLC."""
    loaded = load(config)
    known = tags_by_key(loaded)
    target = known.get(tag)
    if target is None:
        raise ConfigError(f"there is no tag {tag} in {config}{suggestion(tag, known)}")
    if target.write is None:
        if target.inputs:
            raise ConfigError(f"{tag} cannot be written: its value follows from other reads")
        raise ConfigError(f"{tag} cannot be written: it has no `write: true` in {config}")
    parsed = _parsed(value, target)
    try:
        target.encode(parsed)
    except BadValue as error:
        raise BadValue(f"{tag}: {error}") from None
    if without_gateway:
        answer = _write_directly(loaded, target, parsed)
    else:
        with connected(loaded, err.print) as client:
            answer = client.write(tag, parsed)
    if as_json:
        print(json.dumps(answer))
    elif "error" in answer:
        err.print(outcome(tag, answer), style="red")
    else:
        held = any(one.served for one in loaded.devices if one.name == target.device)
        print(outcome(tag, answer, held=held))
    if "error" in answer:
        sys.exit(error_code(answer))


def _parsed(text: str, tag: Tag) -> Value:
    """Returns the value that the text means for this tag."""
    if tag.names is not None and text in tag.names.by_number.values():
        return text  # `on` is a name here
    kind, parsed = tag.layout.type.kind, parse_value(text)
    if kind is Kind.BOOL and text.lower() in _SWITCH:
        return _SWITCH[text.lower()]
    if kind is Kind.STRING and not isinstance(parsed, str):
        return text  # 12 is a text for this tag
    return parsed


def _write_directly(config: Config, tag: Tag, value: Value) -> dict[str, object]:
    """Writes without a gateway. Returns the outcome in the words of a gateway."""
    from gateway.cli import direct

    try:
        encoded = payload.outcome(direct.run(direct.write(config, tag, value)))
    except GatewayError as error:
        encoded = payload.outcome(payload.failure(error))
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
    return f"{target} = {value_text(answer['value'])}: {how}, {took}"
