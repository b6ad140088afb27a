"""Inserts tags into the text of a YAML file; every other character stays, with all comments."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from textwrap import dedent, indent
from typing import NamedTuple

import yaml

from gateway.config.messages import one_of, similar
from gateway.config.yaml.events import plain_data
from gateway.config.yaml.file import compose
from gateway.errors import ConfigError

Settings = Mapping[str, object]
_PLAIN = re.compile(r"\w[\w .°/+()²³µ-]*\Z")
_INDENT = 2


class _Spot(NamedTuple):
    """The text from `start` to `end` is replaced by `before`, the tags, and `after`."""

    start: int
    end: int
    indent: int  # of the tags
    before: str = ""
    after: str = ""
    flow: bool = False


def with_tags(name: str, text: str, device: str, tags: Mapping[str, Settings], comment: str) -> str:
    """Returns the text of a configuration with more tags of a device, below a comment.

    `name`: of the file, for messages.
    Raises `ConfigError` where the file has a form that this cannot extend.
    """
    newline = "\r\n" if "\r\n" in text else "\n"
    key, node = _device(compose(name, text), device, name)
    spot = _spot(text, key, node, device)
    begin = "" if spot.flow else f"{' ' * spot.indent}# {comment}\n"
    rows = [f"{' ' * spot.indent}{entry(name, raw)}" for name, raw in tags.items()]
    body = begin + (",\n" if spot.flow else "\n").join(rows)
    put = (spot.before + body + spot.after).replace("\n", newline)
    return text[: spot.start] + put + text[spot.end :]


def with_block(name: str, text: str, path: Sequence[str], block: str) -> str:
    """Returns the text of a configuration with more entries of the mapping at `path`.

    `block`: the entries, as YAML. Raises as `with_tags`.
    """
    node: yaml.Node = compose(name, text)
    for part in path:
        node = next((value for key, value in _entries(node) if key.value == part), node)
    entries = _entries(node)
    if not entries or getattr(node, "flow_style", True):
        raise ConfigError(f"{'.'.join(path)} in {name} is no block with entries: add them by hand")
    newline = "\r\n" if "\r\n" in text else "\n"
    end = _end_of(text, entries[-1][1])
    put = indent(dedent(block).rstrip(), " " * entries[0][0].start_mark.column)
    return f"{text[:end]}{newline}{put.replace(chr(10), newline)}{text[end:]}"


def entry(name: str, raw: Settings) -> str:
    """Returns a tag as a line of YAML: `speed: {address: D100, scale: 0.1}`."""
    return f"{written(name)}: {flow(raw)}"


def flow(value: object) -> str:
    """Returns data as YAML in one line."""
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{written(k)}: {flow(v)}' for k, v in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(flow, value))}]"
    return "null" if value is None else written(value)


def written(value: object) -> str:
    """Returns a scalar as YAML writes it; in quotes where it would be read as another."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if not isinstance(value, str):
        return f"{value:.15g}" if isinstance(value, float) else str(value)
    if _PLAIN.match(value) and value == value.strip():
        return value if _reads_as_text(value) else json.dumps(value)
    return json.dumps(value, ensure_ascii=not value.isprintable())


def _reads_as_text(text: str) -> bool:
    return plain_data(f"x: {{y: {text}, z: 1}}".encode(), frozenset()) == {"x": {"y": text, "z": 1}}


def _device(root: yaml.MappingNode, device: str, file: str) -> tuple[yaml.Node, yaml.MappingNode]:
    """Returns the key and the settings of a device."""
    found = dict(_devices(root))
    if device not in found:
        close = similar(device, found)
        hint = f"did you mean {close}?" if close else f"the file has {one_of(found)}"
        raise ConfigError(f"there is no device {device} in {file}: {hint}")
    key, node = found[device]
    if not isinstance(node, yaml.MappingNode) or node.start_mark.index < key.end_mark.index:
        raise ConfigError(f"{device} is no mapping of its own in {file}: {_USE}")
    return key, node


_USE = "write `tags_from: <sheet>` into the device instead"


def _devices(root: yaml.Node) -> Iterator[tuple[str, tuple[yaml.Node, yaml.Node]]]:
    for name, lines in _entries(root):
        if name.value == "lines":
            for _, line in _entries(lines):
                for key, devices in _entries(line):
                    if key.value == "devices":
                        yield from ((str(k.value), (k, v)) for k, v in _entries(devices))


def _entries(node: yaml.Node) -> list[tuple[yaml.Node, yaml.Node]]:
    return node.value if isinstance(node, yaml.MappingNode) else []


def _spot(text: str, key: yaml.Node, node: yaml.MappingNode, device: str) -> _Spot:
    tags = next(((k, v) for k, v in node.value if k.value == "tags"), None)
    if node.flow_style:
        return _in_flow(text, key, node, tags, device)
    column = node.value[0][0].start_mark.column
    if tags is None:
        end = _end_of(text, node.value[-1][1])
        return _Spot(end, end, column + _INDENT, f"\n{' ' * column}tags:\n")
    name, value = tags
    if value.start_mark.index < name.end_mark.index:
        raise ConfigError(f"the tags of {device} are an alias: {_USE}")
    if isinstance(value, yaml.MappingNode) and value.value:
        if value.flow_style:
            return _after_brace(text, value, column + _INDENT)
        end = _end_of(text, value.value[-1][1])
        return _Spot(end, end, value.value[0][0].start_mark.column, "\n")
    if isinstance(value, yaml.MappingNode) or value.value in ("", "~", "null"):
        # `tags: {}  # comment`: the braces go, the comment stays on its line
        end = _line_end(text, max(name.end_mark.index, value.end_mark.index))
        colon = text.index(":", name.end_mark.index) + 1
        rest = text[max(colon, value.end_mark.index) : end].rstrip()
        rest = f"  {rest.lstrip()}" if rest.strip() else ""
        return _Spot(colon, end, column + _INDENT, f"{rest}\n")
    raise ConfigError(f"the tags of {device} are no mapping: {_USE}")


def _in_flow(
    text: str,
    key: yaml.Node,
    node: yaml.MappingNode,
    tags: tuple[yaml.Node, yaml.Node] | None,
    device: str,
) -> _Spot:
    """A device in braces: on one line, without tags, it becomes a block."""
    if tags is not None and isinstance(tags[1], yaml.MappingNode) and tags[1].value:
        return _after_brace(text, tags[1], key.start_mark.column + 2 * _INDENT)
    if node.start_mark.line != node.end_mark.line or node.start_mark.line != key.start_mark.line:
        raise ConfigError(f"{device} is written in braces over several lines: {_USE}")
    indent = key.start_mark.column + _INDENT
    rows = [
        f"{' ' * indent}{text[k.start_mark.index : v.end_mark.index]}"
        for k, v in node.value
        if k.value != "tags"
    ]
    end = _line_end(text, node.end_mark.index)
    rest = text[node.end_mark.index : end].rstrip()
    colon = text.index(":", key.end_mark.index) + 1
    before = "\n".join(
        [f"  {rest.lstrip()}" if rest.strip() else "", *rows, f"{' ' * indent}tags:"]
    )
    return _Spot(colon, end, indent + _INDENT, before + "\n")


def _after_brace(text: str, node: yaml.MappingNode, indent: int) -> _Spot:
    start = node.start_mark.index + 1
    after = "," if text[start:].lstrip(" ").startswith(("\n", "\r")) else ",\n" + " " * indent
    return _Spot(start, start, indent, "\n", after, flow=True)


def _end_of(text: str, node: yaml.Node) -> int:
    """Returns the end of the line on which a value ends, with its comment."""
    end = node.end_mark.index
    while isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        node = last[1] if isinstance(last, tuple) else last
        end = node.end_mark.index
    return _line_end(text, len(text[:end].rstrip()))


def _line_end(text: str, index: int) -> int:
    end = text.find("\n", index)
    if end < 0:
        return len(text)
    return end - 1 if text[end - 1] == "\r" else end
