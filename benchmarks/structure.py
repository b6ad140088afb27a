"""Figures of the code's shape: `python -m benchmarks.structure`."""

import ast
import re
from collections.abc import Callable, Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parent.parent / "gateway"
CIRCLING = re.compile(r"(What|Who|Whoever|Whether|Where|How|That|Those)\b")
PROTOCOLS = re.compile(r"\b(vigor|modbus|computer_link|frames)\b", re.IGNORECASE)
# One module each, however short: a rule, a feature of a tag, what a part declares.
DECLARED = re.compile(
    r"engine/results/|config/tags/features/|parts/\w+/(settings|documents)\.py|parts/\w+/commands/"
)
STATE = {"health", "record", "device", "dev"}  # names under which modules hold device state


@cache
def modules() -> list[tuple[str, ast.Module]]:
    return [
        (str(path.relative_to(ROOT)), ast.parse(path.read_text()))
        for path in sorted(ROOT.rglob("*.py"))
    ]


def docstrings(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""


def names_protocol(tree: ast.Module) -> bool:
    """The module imports from a protocol's folder."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and PROTOCOLS.search(node.module or ""):
            return True
    return False


def fields(node: ast.ClassDef) -> int:
    """Attributes assigned in the class or to `self` anywhere in it."""
    found = {
        item.target.id
        for item in node.body
        if isinstance(item, ast.AnnAssign)
        and isinstance(item.target, ast.Name)
        and not ast.unparse(item.annotation).startswith("InitVar")  # an argument, not a field
    }
    for item in ast.walk(node):
        if (
            isinstance(item, ast.Attribute)
            and isinstance(item.ctx, ast.Store)
            and isinstance(item.value, ast.Name)
            and item.value.id == "self"
        ):
            found.add(item.attr)
    return len(found)


def arguments(node: ast.ClassDef) -> int:
    """Arguments of the constructor, without `self`."""
    for item in node.body:
        if isinstance(item, ast.FunctionDef) and item.name == "__init__":
            return len(item.args.args) + len(item.args.kwonlyargs) - 1
    return 0


def assigns_state(tree: ast.Module) -> bool:
    """The module assigns an attribute of a device, its health or its record."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Attribute) or not isinstance(node.ctx, ast.Store):
            continue
        owner = node.value
        if isinstance(owner, ast.Attribute) and getattr(owner.value, "id", "") == "self":
            continue  # its own: the engine's record is that of the line
        name = owner.attr if isinstance(owner, ast.Attribute) else getattr(owner, "id", "")
        if name in STATE:
            return True
    return False


def foreign_assignments(room: str) -> int:
    """Assignments in a folder to an attribute of an object other than `self` or `cls`."""
    return sum(
        isinstance(node, ast.Attribute)
        and isinstance(node.ctx, ast.Store)
        and getattr(node.value, "id", "") not in ("self", "cls")
        for file, tree in modules()
        if file.startswith(f"{room}/")
        for node in ast.walk(tree)
    )


def rooms() -> list[str]:
    """The folders of gateway/."""
    return sorted(path.name for path in ROOT.iterdir() if (path / "__init__.py").exists())


@cache
def imports() -> dict[str, set[str]]:
    """The modules of gateway/, each with those that it imports, also inside of functions."""
    known = {module_name(file): tree for file, tree in modules()}
    found: dict[str, set[str]] = {}
    for name, tree in known.items():
        named = set[str]()
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                base = node.module or ""
                each = (f"{base}.{one.name}" for one in node.names)
                named |= {one if one in known else base for one in each}
            elif isinstance(node, ast.Import):
                named |= {one.name for one in node.names}
        found[name] = {one for one in named if one in known} - {name}
    return found


def module_name(file: str) -> str:
    return "gateway." + file.removesuffix(".py").removesuffix("__init__").replace("/", ".").rstrip(
        "."
    )


def arrows() -> dict[str, set[str]]:
    """The rooms, each with those that its modules import."""
    found = {room: set[str]() for room in rooms()}
    for name, named in imports().items():
        room = name.split(".")[1] if "." in name else ""
        if room == "parts" and ".commands." in name:
            room = "cli"  # a command is a client of the gateway, wherever it stands
        if room in found:
            found[room] |= {one.split(".")[1] for one in named if "." in one} & found.keys() - {
                room
            }
    return found


def circle(graph: dict[str, set[str]]) -> list[str]:
    """Returns one circle of imports; empty: there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def fullest() -> tuple[int, str]:
    """Returns the most files of a folder, and its name."""
    folders = (path.parent for path in ROOT.rglob("__init__.py"))
    return max((len(list(one.glob("*.py"))), str(one.relative_to(ROOT.parent))) for one in folders)


def crowded(least: int = 40, most: int = 300) -> list[str]:
    """Modules with more lines than that, or fewer and a single importer."""
    graph = imports()
    found = []
    for path in sorted(ROOT.rglob("*.py")):
        file, lines = str(path.relative_to(ROOT)), len(path.read_text().splitlines())
        name = module_name(file)
        importers = sum(name in named for named in graph.values())
        alone = importers == 1 and path.stem not in ("__init__", "__main__")
        small = lines < least and alone and not DECLARED.match(file)
        if lines > most or small:
            found.append(f"{file} {lines}")
    return found


def is_settings(file: str, node: ast.ClassDef) -> bool:
    """Frozen dataclasses and models of the file are settings records; so are types of documents,
    which have no state."""
    frozen = any("frozen=True" in ast.unparse(decorator) for decorator in node.decorator_list)
    typed = any("TypedDict" in ast.unparse(base) for base in node.bases)
    return frozen or typed or file.startswith(("config/", "contract/documents/"))


def classes() -> list[tuple[int, int, str]]:
    """Fields, arguments of the constructor and name of each class that is no settings record."""
    return [
        (fields(node), arguments(node), f"{file}: {node.name}")
        for file, tree in modules()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef) and not is_settings(file, node)
    ]


def engine_imports() -> dict[str, set[str]]:
    return {name: to for name, to in imports().items() if name.startswith("gateway.engine.")}


def widest() -> tuple[int, int, str]:
    """As `classes`, of the constructor with the most arguments."""
    return max(classes(), key=lambda each: each[1])


# The rows of docs/contributors/architecture.md, without those of `benchmarks.moves`.
FIGURES: dict[str, Callable[[], list[int]]] = {
    "modules directly in": lambda: [
        len(list(ROOT.glob("*.py"))),
        len(arrows()),
        sum(map(len, arrows().values())),
    ],
    "assignments in": lambda: [foreign_assignments("engine")],
    "fields of the largest class": lambda: [max(classes())[0], widest()[1]],
}


def main() -> None:
    found = modules()
    outside = [
        file
        for file, tree in found
        if not file.startswith(("protocols/", "stations/", "serving/")) and names_protocol(tree)
    ]
    circling = sum(bool(CIRCLING.match(text)) for _, tree in found for text in docstrings(tree))
    assigning = [file for file, tree in found if assigns_state(tree)]
    largest, most = max(classes()), widest()
    print(f"modules directly in gateway/: {len(list(ROOT.glob('*.py')))}")
    print(f"modules outside protocols/, stations/ and serving/ that import a protocol: {outside}")
    print(f"docstrings that begin with What, Who, Whether, Where, How, That: {circling}")
    print(f"most fields of a class: {largest[0]} ({largest[2]})")
    print(f"most arguments of a constructor: {most[1]} ({most[2]})")
    print(f"modules that assign state of a device from outside: {assigning}")
    foreign = {room: foreign_assignments(room) for room in rooms()}
    print(f"assignments to attributes of other objects: {foreign}")
    graph, inside = arrows(), circle(engine_imports())
    print(f"rooms: {len(graph)}; arrows between them: {sum(map(len, graph.values()))}")
    print(f"circles between rooms: {circle(graph)}; inside the engine: {inside}")
    print("most files of a folder: {} ({})".format(*fullest()))
    print(f"modules over 300 lines, or below 40 with one importer: {crowded()}")


if __name__ == "__main__":
    main()
