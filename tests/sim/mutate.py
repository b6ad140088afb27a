"""Makes mutants: the text of a module with one rule broken, by operators on its syntax tree.

A mutant replaces one piece of text, so that each other line keeps its number. It has a name that
depends only on the module: `engine/health.py:Health.gave_up:swap:0` is the first comparison there.
"""

import ast
import random
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

GATEWAY = Path(__file__).parents[2] / "gateway"

SWAPPED: dict[type[ast.AST], str] = {
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.Lt: ">",
    ast.Gt: "<",
    ast.LtE: ">=",
    ast.GtE: "<=",
    ast.In: "not in",
    ast.NotIn: "in",
    ast.Is: "is not",
    ast.IsNot: "is",
}
BOUNDS: dict[type[ast.AST], str] = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">"}
SUMS: dict[type[ast.AST], str] = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.FloorDiv: "*"}
CHOICES = {"min": "max", "max": "min", "any": "all", "all": "any"}
NO_RULES = ("__repr__", "__str__")
Of = Callable[[ast.expr], str]
Change = tuple[str, ast.expr | ast.stmt, str]  # the operator, the replaced node, the new text
LOG = re.compile(r"[\w.]*\blog\.\w+\(")


@dataclass(frozen=True, slots=True)
class Mutant:
    """One replacement in a module: the bytes from `begin` to `end` become `new`."""

    name: str
    module: str  # below gateway/
    begin: int
    end: int
    new: str

    def text(self) -> str:
        """Returns the module with its rule broken."""
        raw = (GATEWAY / self.module).read_bytes()
        return (raw[: self.begin] + self.new.encode() + raw[self.end :]).decode()

    def __str__(self) -> str:
        raw = (GATEWAY / self.module).read_bytes()
        line = raw.count(b"\n", 0, self.begin) + 1
        old = " ".join(raw[self.begin : self.end].decode().split())
        return f"{self.name}  (line {line}: {old[:60]} -> {self.new[:60]})"


def mutants_of(module: str) -> list[Mutant]:
    """Returns all mutants of a module."""
    raw = (GATEWAY / module).read_bytes()
    starts = [0, *accumulate(len(line) + 1 for line in raw.split(b"\n"))]

    def place(node: ast.expr | ast.stmt) -> tuple[int, int]:
        begin = starts[node.lineno - 1] + node.col_offset
        return begin, starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)

    def of(node: ast.expr) -> str:
        return f"({raw[slice(*place(node))].decode()})"

    count: Counter[tuple[str, str]] = Counter()
    found = []
    for function, rule in _rules(ast.parse(raw), ""):
        for operator, node, new in _changes(rule, of):
            number = count[function, operator]
            count[function, operator] += 1
            name = f"{module}:{function}:{operator}:{number}"
            found.append(Mutant(name, module, *place(node), new))
    return found


def sample(mutants: Sequence[Mutant], size: int, seed: int) -> list[Mutant]:
    """Draws mutants. The same seed draws the same ones from the same gateway."""
    return random.Random(seed).sample(mutants, min(size, len(mutants)))


def modules_in(folder: str) -> list[str]:
    """Returns the modules of a folder of gateway/, or the module that it names."""
    place = GATEWAY / folder
    paths = [place] if place.is_file() else sorted(place.rglob("*.py"))
    return [path.relative_to(GATEWAY).as_posix() for path in paths]


def _rules(node: ast.AST, function: str) -> Iterator[tuple[str, ast.AST]]:
    """Yields the nodes that may be a rule, each with the name of its function.

    Annotations, defaults, errors and texts for people are none.
    """
    for child in ast.iter_child_nodes(node):
        match child:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                if child.name not in NO_RULES and not _is_protocol(child):
                    name = f"{function}.{child.name}".lstrip(".")
                    yield from _rules(ast.Module(child.body, []), name)
            case ast.AnnAssign():
                if child.value is not None:
                    yield from _rules(ast.Expression(child.value), function)
            case ast.Raise() | ast.JoinedStr():
                pass
            case ast.Expr() if LOG.match(ast.unparse(child)):
                pass
            case _:
                yield function, child
                yield from _rules(child, function)


def _is_protocol(node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) -> bool:
    bases = node.bases if isinstance(node, ast.ClassDef) else []
    return any(ast.unparse(base).startswith("Protocol") for base in bases)


def _changes(node: ast.AST, of: Of) -> Iterator[Change]:
    """Yields what the operators make of a node; `of` returns the text of an expression."""
    match node:
        case ast.stmt():
            yield from _of_statement(node)
        case ast.Compare(ops=[operator], left=left, comparators=[right]):
            for name, table in (("swap", SWAPPED), ("bound", BOUNDS)):
                if new := table.get(type(operator)):
                    yield name, node, f"({of(left)} {new} {of(right)})"
        case ast.BoolOp(op=operator, values=values):
            both = isinstance(operator, ast.And)
            yield "either", node, f"({(' or ' if both else ' and ').join(map(of, values))})"
            yield from (("part", value, str(both)) for value in values)
        case ast.BinOp(left=left, op=operator, right=right) if new := SUMS.get(type(operator)):
            yield "sum", node, f"({of(left)} {new} {of(right)})"
        case ast.Constant(value=bool() | int() | float() as value):
            yield "constant", node, str(_other(value))
        case ast.Call(func=ast.Name(id=name) as called) if name in CHOICES:
            yield "choice", called, CHOICES[name]
    yield from _of_condition(node, of)


def _of_statement(node: ast.stmt) -> Iterator[Change]:
    match node:
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]) | ast.AugAssign():
            yield "drop", node, "pass"
        case ast.Expr(value=ast.Call() | ast.Await()) | ast.Return() | ast.Delete():
            yield "drop", node, "pass"
        case ast.Break() | ast.Continue():
            yield "drop", node, "pass"


def _of_condition(node: ast.AST, of: Of) -> Iterator[Change]:
    match node:
        case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
            if not isinstance(test, ast.Compare):  # `swap` does it
                yield "negate", test, f"(not {of(test)})"
            yield "skip", test, "False"
        case ast.match_case(guard=ast.expr() as guard):
            yield "skip", guard, "False"
        case ast.comprehension(ifs=tests):
            yield from (("skip", test, "True") for test in tests)


def _other(value: float) -> float:
    match value:
        case bool():
            return not value
        case int():
            return value + 1
        case _:
            return value * 2 + 1
