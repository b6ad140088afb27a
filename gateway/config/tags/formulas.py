"""The grammar of `computed`, and its parser: names, numbers, + - * / ( ) abs min max."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import reduce
from typing import Any

from lark import Lark, Token, Transformer
from lark.exceptions import UnexpectedCharacters, UnexpectedInput, UnexpectedToken

from gateway.errors import ConfigError
from gateway.tags.formula import ONE_SIDED, OPERATIONS, Term

LONGEST = 300  # characters; it limits the depth of brackets too
USE = "use names, numbers, + - * / ( ) and abs, min, max"
_GRAMMAR = r"""
?start: sum
?sum: product | sum /[+-]/ product -> two
?product: factor | product /[*\/]/ factor -> two
?factor: atom | MINUS atom -> one
?atom: NUMBER -> number
    | NAME -> name
    | QUOTED -> quoted
    | "(" sum ")"
    | ONE_SIDED "(" sum ")" -> one
    | FUNCTION "(" sum ("," sum)+ ")" -> several
MINUS: "-"
ONE_SIDED.2: /abs(?=\s*\()/
FUNCTION.2: /(min|max)(?=\s*\()/
NUMBER: /[0-9]+(\.[0-9]+)?/
NAME: /[^\W\d][\w.]*/
QUOTED: /'[^']+'|"[^"]+"/
%ignore /\s+/
"""


@dataclass(slots=True)
class Parsed:
    """A formula before its names are known. `names`: in the order of the inputs of `term`."""

    term: Term
    names: list[str] = field(default_factory=list)
    whole: bool = True  # no division, and no number with a fraction


def parse(text: str) -> Parsed:
    """Returns the formula of a text. Raises `ConfigError` with the place of the mistake."""
    if len(text) > LONGEST:
        raise ConfigError(f"{len(text)} characters: a formula has at most {LONGEST}; use two tags")
    build = _Build()
    try:
        term: Any = build.transform(_PARSER.parse(text))
    except UnexpectedInput as error:
        raise ConfigError(f"{text!r}: {_problem(text, error)}") from None
    return Parsed(term, build.names, build.whole)


def _problem(text: str, error: UnexpectedInput) -> str:
    if isinstance(error, UnexpectedToken) and error.token.type == "$END":
        return "it ends too early"
    if (
        not isinstance(error, (UnexpectedToken, UnexpectedCharacters))
        or error.pos_in_stream is None
    ):
        return USE
    return f"{text[error.pos_in_stream :][:20]!r} cannot stand here: {USE}"


class _Build(Transformer[Token, Term]):
    """Makes a function of each part. Nothing of the text is ever executed."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []
        self.whole = True

    def number(self, parts: Sequence[Token]) -> Term:
        number = Decimal(str(parts[0]))
        self.whole = self.whole and "." not in parts[0]
        return lambda _: number

    def name(self, parts: Sequence[Token]) -> Term:
        return self._input(str(parts[0]))

    def quoted(self, parts: Sequence[Token]) -> Term:
        return self._input(str(parts[0])[1:-1])

    def _input(self, name: str) -> Term:
        if name not in self.names:
            self.names.append(name)
        place = self.names.index(name)
        return lambda values: values[place]

    def one(self, parts: Sequence[Any]) -> Term:
        function, term = parts
        single = ONE_SIDED[str(function)]
        return lambda values: single(term(values))

    def two(self, parts: Sequence[Any]) -> Term:
        left, sign, right = parts
        operation = OPERATIONS[str(sign)]
        self.whole = self.whole and sign != "/"
        return lambda values: operation(left(values), right(values))

    def several(self, parts: Sequence[Any]) -> Term:
        function, *terms = parts
        operation = OPERATIONS[str(function)]
        return lambda values: reduce(operation, (term(values) for term in terms))


_PARSER = Lark(_GRAMMAR, parser="lalr", maybe_placeholders=False)
