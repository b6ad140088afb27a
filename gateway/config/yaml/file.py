"""The YAML file as plain data that knows the line of everything in it.

A key is always a text. A key written twice is a mistake, and so is anything that only makes sense
to a Python program. A plain file is read as a stream; its tree is made for the lines of mistakes.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import yaml

from gateway import files
from gateway.config.messages import ConfigErrors, Mistakes, Path, dotted
from gateway.config.yaml.events import plain_data
from gateway.config.yaml.scalars import scalar
from gateway.config.yaml.syntax import DEEPEST, TOO_DEEP, line_of, syntax_mistake

Entries = dict[str, tuple[yaml.Node, yaml.Node]]

_KINDS = {yaml.ScalarNode: "str", yaml.SequenceNode: "seq", yaml.MappingNode: "map"}
_TAGS = {kind: f"tag:yaml.org,2002:{name}" for kind, name in _KINDS.items()}


def _descend(loader: Any, parent: yaml.Node | None, _index: object) -> None:
    """Limits the depth: the reader is recursive, and some thousands of levels end in a crash."""
    loader.depth += 1
    if loader.depth > DEEPEST and parent is not None:
        raise yaml.MarkedYAMLError(problem=TOO_DEEP, problem_mark=parent.start_mark)


def _ascend(loader: Any) -> None:
    loader.depth -= 1


# Settings that are texts even where YAML sees a number: `7E1`, `40101`, `unit: 1`.
TEXTS = frozenset({"address", "description", "format", "name", "port", "prefix", "unit"})

# libyaml is ten times faster; PyYAML's own reader is the fallback. This module finds the type of
# a scalar, so PyYAML's own search for it (half of its time) is left out.
_LOADER: Any = type(
    "_Loader",
    (yaml.CBaseLoader if yaml.__with_libyaml__ else yaml.BaseLoader,),
    {
        "resolve": lambda _self, kind, _value, _implicit: _TAGS[kind],
        "depth": 0,
        "descend_resolver": _descend,
        "ascend_resolver": _ascend,
    },
)

# Limits the growth of a small file by aliases; ten times a gateway of 10,000 tags.
_MOST_NODES = 2_000_000
# Advice by words in the message of the reader; the first match counts.
_PLAIN_TAGS = set(_TAGS.values())


@dataclass(slots=True)
class YamlFile:
    """One file; `data` is dicts, lists, texts, numbers, booleans and None."""

    name: str
    text: str
    texts: frozenset[str]
    data: dict[str, Any] = field(default_factory=dict)
    _root: yaml.MappingNode | None = None
    _entries: dict[int, Entries] = field(default_factory=dict)
    _open: set[int] = field(default_factory=set)
    _nodes: int = 0

    def line(self, path: Path) -> int:
        """Returns the line, from 1, of the deepest part of `path` in the file."""
        node: yaml.Node = self._tree()
        mark = node.start_mark
        for chunk in path:
            if isinstance(node, yaml.MappingNode) and chunk in (entries := self._of(node)):
                key, node = entries[str(chunk)]
                mark = key.start_mark
            elif isinstance(node, yaml.SequenceNode) and chunk in range(len(node.value)):
                node = node.value[chunk]
                mark = node.start_mark
            else:
                break
        return line_of(mark)

    def at(self, line: int, path: Path) -> str:
        return f"{self.name}:{line}: {dotted(path) + ': ' if path else ''}"

    def read(self, mistakes: Mistakes, report: Callable[[float], None] | None = None) -> None:
        """Fills `data`, and notes YAML that a configuration must not use.

        Raises `ConfigErrors` where the file cannot be read.
        """
        found = plain_data(self.text.encode(), self.texts, report)
        if found is None:
            found = self._plain(self._tree(), (), mistakes)
        self.data = found if isinstance(found, dict) else {}

    def _tree(self) -> yaml.MappingNode:
        if self._root is None:
            self._root = compose(self.name, self.text)
        return self._root

    def _plain(self, node: yaml.Node, path: Path, mistakes: Mistakes) -> Any:
        self._nodes += 1
        if self._nodes > _MOST_NODES or id(node) in self._open or len(path) > DEEPEST:
            raise ConfigErrors(
                [f"{self.name}:{line_of(node.start_mark)}: its anchors repeat without end"]
            )
        if node.tag not in _PLAIN_TAGS:
            mistakes.add(f"{node.tag!r} cannot be used here: write the value alone", *path)
            return None
        if isinstance(node, yaml.ScalarNode):
            text = str(node.value)
            if node.style not in (None, "") or (path and path[-1] in self.texts and text):
                return text
            return scalar(text)
        self._open.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            result: Any = [
                self._plain(item, (*path, i), mistakes) for i, item in enumerate(node.value)
            ]
        else:
            assert isinstance(node, yaml.MappingNode)  # noqa: S101  YAML has no fourth kind
            self._check_keys(node, path, mistakes)
            self._check_merges(node, path, mistakes)
            result = {
                name: self._plain(value, (*path, name), mistakes)
                for name, (_, value) in self._of(node).items()
            }
        self._open.discard(id(node))
        return result

    def _check_keys(self, node: yaml.MappingNode, path: Path, mistakes: Mistakes) -> None:
        first: dict[str, int] = {}
        for key, _ in node.value:
            line = line_of(key.start_mark)
            if not isinstance(key, yaml.ScalarNode):
                mistakes.add(f"the key in line {line} is no plain name", *path)
            elif key.value in first and not _is_merge(key):
                both = "in one line" if first[key.value] == line else f"in line {line}"
                mistakes.at(*path, key.value).add(
                    f"written twice, here and again {both}: only one of them can be meant"
                )
            else:
                first[key.value] = line

    def _check_merges(self, node: yaml.MappingNode, path: Path, mistakes: Mistakes) -> None:
        merges = [(line_of(key.start_mark), value) for key, value in node.value if _is_merge(key)]
        for line, value in merges:
            if not all(isinstance(one, yaml.MappingNode) for one in _parts(value)):
                mistakes.at(*path).add(
                    f"the `<<` in line {line} brings in no settings: write it as `<<: *name`"
                )
        if len(merges) > 1:
            lines = " and ".join(str(line) for line, _ in merges)
            mistakes.at(*path).add(
                f"`<<` is written twice, in lines {lines}: write one, `<<: [*first, *second]`"
            )

    def _of(self, node: yaml.MappingNode) -> Entries:
        """Returns the entries by name; the first of equal keys counts, and those of `<<` last."""
        if id(node) not in self._entries:
            self._entries[id(node)] = {}  # a mapping merged into itself brings nothing
            own: Entries = {}
            for key, value in node.value:
                if isinstance(key, yaml.ScalarNode) and not _is_merge(key):
                    own.setdefault(str(key.value), (key, value))
            for merged in _merged(node):
                for name, entry in self._of(merged).items():
                    own.setdefault(name, entry)
            self._entries[id(node)] = own
        return self._entries[id(node)]


def read_yaml(
    path: FilePath,
    texts: frozenset[str],
    report: Callable[[float], None] | None = None,
    text: str | None = None,
) -> tuple[YamlFile, Mistakes]:
    """Returns the file and the mistakes found so far.

    `texts` are the keys whose values are texts even where they look like numbers (`7E1`). `report`
    receives the share that is read. `text`: in place of that of the file.
    Raises `ConfigErrors` where the file cannot be read.
    """
    file = YamlFile(str(path), file_text(path) if text is None else text, texts)
    mistakes = Mistakes(file)
    file.read(mistakes, report)
    return file, mistakes


def compose(name: str, text: str) -> yaml.MappingNode:
    """Returns the tree of a file. Raises `ConfigErrors` with the place of a mistake."""
    try:
        root = yaml.compose(text.encode(), Loader=_LOADER)
    except yaml.MarkedYAMLError as error:
        raise ConfigErrors([syntax_mistake(name, text, error)]) from None
    except yaml.reader.ReaderError as error:
        line = text.encode()[: error.position].count(b"\n") + 1
        raise ConfigErrors([f"{name}:{line}: a control character: delete it"]) from None
    if root is None:
        raise ConfigErrors([f"{name}:1: the file is empty: it needs at least `lines:`"])
    if not isinstance(root, yaml.MappingNode):
        begin = "a file begins with names such as `gateway:` and `lines:`, each with a colon"
        raise ConfigErrors([f"{name}:{line_of(root.start_mark)}: no settings: {begin}"])
    return root


def file_text(path: FilePath) -> str:
    try:
        data = files.read(path)
    except FileNotFoundError:
        raise ConfigErrors([f"{path}: there is no such file"]) from None
    except IsADirectoryError:
        raise ConfigErrors([f"{path}: this is a folder: name the file in it"]) from None
    except OSError as error:
        raise ConfigErrors([f"{path}: cannot be read: {error.strerror}"]) from None
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise ConfigErrors([f"{path}:1: the file is UTF-16: save it as UTF-8"])
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigErrors(
            [f"{path}:{line}: byte 0x{data[error.start]:02x} is no UTF-8: save the file as UTF-8"]
        ) from None


def _is_merge(key: yaml.Node) -> bool:
    return isinstance(key, yaml.ScalarNode) and key.value == "<<" and key.style in (None, "")


def _merged(node: yaml.MappingNode) -> Iterator[yaml.MappingNode]:
    for key, value in node.value:
        if _is_merge(key):
            yield from (one for one in _parts(value) if isinstance(one, yaml.MappingNode))


def _parts(value: yaml.Node) -> list[yaml.Node]:
    """Returns the mappings of one `<<`: a mapping, or a list of mappings."""
    return value.value if isinstance(value, yaml.SequenceNode) else [value]
