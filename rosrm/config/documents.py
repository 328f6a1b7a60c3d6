"""YAML documents with the place of every value, for messages with line and column.

Plain scalars follow YAML 1.2: only `true` and `false` are booleans (not `on` or `no`), `010` is
ten, and no text becomes a date.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Union

import yaml

from rosrm.errors import ConfigError
from rosrm.wording import reason_of

#: Highest number of values in one file; values behind an alias count at each use of the alias.
MOST_VALUES: Final = 200_000
#: Maximum size of a file in bytes: reading a file of this size takes some seconds.
_LARGEST: Final = 1 << 24
#: Key whose mappings are merged into the one around it.
_MERGE: Final = "<<"
#: Beginning of the keys of a file that rosrm leaves to its users, such as for anchors.
_EXTENSION: Final = "x-"
#: Ends of the names of launch files of ROS 2 that are no YAML.
_LAUNCH_FILES: Final = ("launch.py", "launch.xml")


@dataclass(frozen=True, slots=True, order=True)
class Place:
    """Line and column of a file, from 1; line 0: an option of the command line."""

    file: str
    line: int
    column: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}" if self.line else self.file


@dataclass(frozen=True, slots=True)
class Node:
    """Value of a document, with its place and the place of its key, if any."""

    value: Value
    place: Place
    key_place: Place | None = None

    def plain(self) -> Any:
        """Return the value without places, in JSON types."""
        if isinstance(self.value, Mapping):
            return {key: item.plain() for key, item in self.value.items()}
        if isinstance(self.value, tuple):
            return [item.plain() for item in self.value]
        return self.value

    def get(self, *path: str | int) -> Node | None:
        """Return the node at a path; None if there is none."""
        node: Node | None = self
        for step in path:
            node = None if node is None else node.child(step)
        return node

    def deepest(self, path: tuple[str | int, ...]) -> Node:
        """Return the node at a path or, if that is missing, its deepest existing ancestor."""
        node = self
        for step in path:
            inner = node.child(step)
            if inner is None:
                return node
            node = inner
        return node

    def child(self, step: str | int) -> Node | None:
        """Return the node under a key or index; None if there is none."""
        if isinstance(self.value, Mapping) and isinstance(step, str):
            return self.value.get(step)
        if isinstance(self.value, tuple) and isinstance(step, int) and step < len(self.value):
            return self.value[step]
        return None

    @property
    def items(self) -> Mapping[str, Node]:
        """Return the members of a mapping; none for any other value."""
        return self.value if isinstance(self.value, Mapping) else {}


Value = Union[None, bool, int, float, str, "tuple[Node, ...]", "Mapping[str, Node]"]


@dataclass
class Problems:
    """Problems of a file, collected to be reported together."""

    found: dict[tuple[Place, str], None] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.found)

    def add(self, place: Place, text: str) -> None:
        """Note a problem; drop a duplicate at the same place."""
        self.found[place, text] = None

    def raise_any(self) -> None:
        """Raise one `ConfigError` for all problems, if there are any."""
        if not self.found:
            return
        lines = list(_allowed_once(f"{place}: {text}" for place, text in sorted(self.found)))
        if len(lines) == 1:
            raise ConfigError(lines[0])
        raise ConfigError("\n  ".join([f"{len(lines)} errors{self._in_file()}", *lines]))

    def _in_file(self) -> str:
        """Return the file of all problems; "": they are in several options of a command line."""
        files = {place.file for place, _ in self.found}
        return f" in {files.pop()}" if len(files) == 1 else ""


def _allowed_once(lines: Iterable[str]) -> Iterator[str]:
    """Yield the lines; print each list of allowed values only with its first line."""
    shown = set()
    for line in lines:
        fault, mark, allowed = line.partition(" Allowed: ")
        yield fault if allowed in shown else line
        shown.update([allowed] if mark else [])


def read(path: str | Path) -> Node:
    """Read a file; raises `ConfigError` with line and column if it is unreadable.

    `-` is the standard input. A launch file of ROS 2 is refused.
    """
    path = Path(path)
    text = _text(path)
    root = None if path.name.endswith(_LAUNCH_FILES) else parse(text, str(path))
    if root is None or root.items.keys() == {"launch"}:
        raise ConfigError(
            f"{path}: this is a launch file of ROS 2; use `rosrm launch {path}` (distribution "
            "rosrm-launch)"
        )
    return root


def parse(text: str, file: str) -> Node:
    """Return the document in a text; an empty text gives an empty mapping.

    Raises:
        ConfigError: the text is not valid YAML.
    """
    try:
        root = _Loader(text).get_single_node()
        return Node({}, Place(file, 1, 1)) if root is None else _Builder(file).build(root)
    except yaml.MarkedYAMLError as error:
        raise ConfigError(f"{_place_of(error, file)}: unreadable YAML: {_text_of(error)}") from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        column = error.position - (text.rfind("\n", 0, error.position) + 1) + 1
        raise ConfigError(
            f"{Place(file, line, column)}: unreadable YAML: the character "
            f"#x{ord(text[error.position]):04x} is not allowed"
        ) from None
    except RecursionError:
        raise ConfigError(f"{file}: unreadable YAML: nested too deeply") from None


def node_of(value: object, place: Place) -> Node:
    """Return a document for values of a Python program; raises `ConfigError` for other types.

    Args:
        value: mappings with text as keys, sequences, text, paths, numbers, booleans and None.
        place: for messages, of all values.
    """
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return Node({key: node_of(item, place) for key, item in value.items()}, place, place)
    if isinstance(value, (list, tuple)):
        return Node(tuple(node_of(item, place) for item in value), place, place)
    if isinstance(value, Path):
        return Node(str(value), place, place)
    if value is None or isinstance(value, (bool, int, float, str)):
        return Node(value, place, place)
    raise ConfigError(
        f"{place}: {value!r} is a {type(value).__name__}. Allowed: mappings with text as keys, "
        f"lists, text, numbers, booleans and None"
    )


def _text(path: Path) -> str:
    try:
        if str(path) == "-":
            content = sys.stdin.buffer.read(_LARGEST + 1)
        else:
            with path.open("rb") as file:
                content = file.read(_LARGEST + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {reason_of(error)}") from None
    if len(content) > _LARGEST:
        raise ConfigError(
            f"{path}: it has more than {_LARGEST >> 20} MiB, so it is probably not a rosrm file. "
            "Divide a larger work file, or use `foreach` and `array` for similar processes"
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        column = error.start - (content.rfind(b"\n", 0, error.start) + 1) + 1
        raise ConfigError(f"{Place(str(path), line, column)}: not UTF-8 text") from None


def _place_of(error: yaml.MarkedYAMLError, file: str) -> Place:
    mark = error.problem_mark or error.context_mark
    return Place(file, mark.line + 1, mark.column + 1) if mark else Place(file, 1, 1)


def _text_of(error: yaml.MarkedYAMLError) -> str:
    return " ".join(part for part in (error.context, error.problem) if part)


# --- YAML 1.2's scalars -----------------------------------------------------------------------


class _Loader(yaml.SafeLoader):
    """YAML loader that composes nodes with marks by the core schema of YAML 1.2."""

    yaml_implicit_resolvers: dict[Any, Any] = {}  # noqa: RUF012 - PyYAML's own shape
    _composed = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Return the next node; refuse a file of too many before it is read to its end."""
        self._composed += 1
        if self._composed > 2 * MOST_VALUES:  # keys are nodes as well
            raise yaml.MarkedYAMLError(
                problem=f"more than {MOST_VALUES} values", problem_mark=self.get_mark()
            )
        return super().compose_node(parent, index)


_TAG: Final = "tag:yaml.org,2002:"
_DECIMAL: Final = r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
_WORDS: Final = {
    "null": (r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    "bool": (r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    "int": (r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", list("-+0123456789")),
    "float": (
        _DECIMAL + r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        list("-+0123456789."),
    ),
}
for _name, (_pattern, _first) in _WORDS.items():
    _Loader.add_implicit_resolver(f"{_TAG}{_name}", re.compile(f"^(?:{_pattern})$"), _first)


def _integer(text: str) -> int:
    if text.startswith(("0o", "0x")):
        return int(text[2:], 8 if text[1] == "o" else 16)
    return int(text)


_SCALARS: Final[Mapping[str, Any]] = {
    f"{_TAG}null": lambda _: None,
    f"{_TAG}bool": lambda text: text.lower() == "true",
    f"{_TAG}int": _integer,
    f"{_TAG}float": lambda text: float(text.lower().replace(".inf", "inf").replace(".nan", "nan")),
    f"{_TAG}str": str,
}


class _Builder:
    """Conversion of PyYAML's nodes to `Node`, which collects all errors of form."""

    def __init__(self, file: str) -> None:
        self._file = file
        self._problems = Problems()
        self._open: set[int] = set()
        self._count = 0

    def build(self, root: yaml.Node) -> Node:
        node = self._node(root, None)
        self._problems.raise_any()
        own = {key: item for key, item in node.items.items() if not key.startswith(_EXTENSION)}
        return Node(own, node.place) if own.keys() != node.items.keys() else node

    def _node(self, node: yaml.Node, key_place: Place | None) -> Node:
        place = self._place(node)
        self._count += 1
        if id(node) in self._open:
            raise ConfigError(f"{place}: an alias that contains itself")
        if self._count > MOST_VALUES:
            raise ConfigError(f"{place}: more than {MOST_VALUES} values")
        self._open.add(id(node))
        value = self._value(node, place)
        self._open.discard(id(node))
        return Node(value, place, key_place)

    def _value(self, node: yaml.Node, place: Place) -> Value:
        if isinstance(node, yaml.MappingNode) and node.tag == f"{_TAG}map":
            return dict(self._members(node))
        if isinstance(node, yaml.SequenceNode) and node.tag == f"{_TAG}seq":
            return tuple(self._node(item, None) for item in node.value)
        if isinstance(node, yaml.ScalarNode) and node.tag in _SCALARS:
            return self._scalar(node, place)
        self._problems.add(place, f"the tag {node.tag!r} is not allowed")
        return None

    def _scalar(self, node: yaml.ScalarNode, place: Place) -> Value:
        try:
            value: Value = _SCALARS[node.tag](node.value)
        except ValueError as error:
            self._problems.add(place, f"{node.value!r} cannot be read: {error}")
            return None
        return value

    def _members(self, mapping: yaml.MappingNode) -> Iterator[tuple[str, Node]]:
        first: dict[str, Place] = {}
        merged: list[yaml.Node] = []
        for key, item in mapping.value:
            place = self._place(key)
            if isinstance(key, yaml.ScalarNode) and (key.value, key.style) == (_MERGE, None):
                merged += item.value if isinstance(item, yaml.SequenceNode) else [item]
                continue
            if not isinstance(key, yaml.ScalarNode) or key.tag != f"{_TAG}str":
                text = repr(key.value) if isinstance(key, yaml.ScalarNode) else "this"
                self._problems.add(
                    place, f"a key must be text, and {text} is not; put it in quotes"
                )
                continue
            if key.value in first:
                before = first[key.value]
                self._problems.add(
                    place,
                    f"the key {key.value!r} is given twice, first at line {before.line}, "
                    f"column {before.column}",
                )
                continue
            first[key.value] = place
            yield key.value, self._node(item, place)
        for base in merged:  # the first one that has a key counts, after the keys given here
            place = self._place(base)
            members = self._node(base, None)
            if not isinstance(members.value, Mapping):
                self._problems.add(
                    place, f"{_MERGE}: a mapping is required, such as `{_MERGE}: *base`"
                )
            for name, node in members.items.items():
                if name not in first:
                    first[name] = node.key_place or node.place
                    yield name, node

    def _place(self, node: yaml.Node) -> Place:
        return Place(self._file, node.start_mark.line + 1, node.start_mark.column + 1)
