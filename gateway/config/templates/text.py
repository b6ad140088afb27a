"""Texts with parameters: `D{base + 2*i}`, `pump-{n:02}`, `{station}`.

An expression has whole numbers, parameters, + - * // % and brackets. Behind a colon stands the form
of a number: `{n:04}` has four digits, `{x:o}` is octal. `{{` is a brace.
"""

import ast
import operator
import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

from gateway.config.messages import meant, shown
from gateway.errors import ConfigError

_PART = re.compile(r"\{\{|\}\}|\{([^{}]*)\}|[{}]")
_FORM = re.compile(r"0?[0-9]{0,2}[doxX]?\Z")
PARAMETER = re.compile(r"[a-z_][a-z0-9_]*\Z", re.IGNORECASE)
_LONGEST = 200  # characters of an expression
_MOST = 10**9
_OPERATIONS: Mapping[type[ast.operator], Callable[[int, int], int]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
}


def has_parameter(text: str, name: str) -> bool:
    """True if an expression in the text uses the parameter."""
    return any(
        isinstance(node, ast.Name) and node.id == name
        for part in _PART.finditer(text)
        if part[1] is not None
        for node in ast.walk(_parsed(part[1].partition(":")[0].strip()))
    )


def filled(text: str, values: Mapping[str, Any]) -> Any:
    """Returns the text with the values of its expressions. A text that is one expression becomes
    its value: a number stays a number. Raises `ConfigError`."""
    if "{" not in text and "}" not in text:
        return text
    whole = _PART.fullmatch(text)
    if whole is not None and whole[1] is not None:
        return _value(whole[1], values)
    return _PART.sub(lambda part: _shown(part, values), text)


def _shown(part: re.Match[str], values: Mapping[str, Any]) -> str:
    if part[1] is None:
        if len(part[0]) == 1:
            raise ConfigError(f"a {part[0]} stands alone: write {part[0] * 2} for the character")
        return part[0][0]
    value = _value(part[1], values)
    return shown(value).strip("'") if isinstance(value, bool) else str(value)


def _value(text: str, values: Mapping[str, Any]) -> Any:
    expression, colon, form = text.partition(":")
    value = _computed(_parsed(expression.strip()), values, text)
    if not colon:
        return value
    if not _FORM.match(form) or not form:
        raise ConfigError(f"{{{text}}}: {form!r} is no form such as 04 (four digits) or o (octal)")
    return format(_whole(value, text), form)


@lru_cache(maxsize=4096)
def _parsed(text: str) -> ast.expr:
    if not text or len(text) > _LONGEST:
        raise ConfigError(f"{{{text[:40]}}} has no expression such as base + 2*n")
    try:
        return ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise ConfigError(f"{{{text}}} is no expression such as base + 2*n") from None


def _computed(node: ast.expr, values: Mapping[str, Any], text: str) -> Any:
    match node:
        case ast.Constant(int() as number) if not isinstance(number, bool):
            return number
        case ast.Name(name) if name in values:
            return values[name]
        case ast.Name(name):
            known = f": {meant(name, values)}" if values else ", and there are none"
            raise ConfigError(f"{{{text}}}: {name} is no parameter here{known}")
        case ast.UnaryOp(ast.USub(), operand):
            return -_whole(_computed(operand, values, text), text)
        case ast.BinOp(left, operation, right) if type(operation) in _OPERATIONS:
            first = _whole(_computed(left, values, text), text)
            second = _whole(_computed(right, values, text), text)
            if second == 0 and isinstance(operation, (ast.FloorDiv, ast.Mod)):
                raise ConfigError(f"{{{text}}} divides by 0")
            return _whole(_OPERATIONS[type(operation)](first, second), text)
    raise ConfigError(f"{{{text}}}: use whole numbers, parameters, + - * // % and brackets")


def _whole(value: Any, text: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ConfigError(f"{{{text}}}: {shown(value)} is no whole number")
    if abs(value) > _MOST:
        raise ConfigError(f"{{{text}}}: {value} is beyond {_MOST}")
    return value
