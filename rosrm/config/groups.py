"""Section `group` of a work file: the processes of the file end together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Final

from rosrm.config.checking import validated
from rosrm.config.documents import Node, Problems
from rosrm.config.process import ListOfWords, Name
from rosrm.config.rules import check_name
from rosrm.model.values import GroupEnd, GroupMembership, ProcessSpec
from rosrm.wording import few, get_close_matches

#: Word for all processes of the file.
_ANY: Final = "any"


@dataclass(frozen=True, slots=True)
class GroupInFile:
    """Group of all processes of a file, and the processes whose end ends the others."""

    EXAMPLES: ClassVar[Mapping[str, Sequence[str]]] = {
        "": ("{name: tests, ends_with: any}",), "ends_with": ("[camera]",), "fails_with": ("any",),
    }  # fmt: skip

    name: Name = ""
    ends_with: ListOfWords = ()
    fails_with: ListOfWords = ()

    def membership(self, process: str) -> GroupMembership:
        """Return the membership of a process of the file."""
        ends: GroupEnd = "never"
        if not {_ANY, process}.isdisjoint(self.ends_with):
            ends = "always"
        elif not {_ANY, process}.isdisjoint(self.fails_with):
            ends = "on-failure"
        return GroupMembership(self.name, ends)


def grouped(
    specs: Sequence[ProcessSpec], root: Node, problems: Problems
) -> tuple[ProcessSpec, ...]:
    """Return the processes of a file as members of its group, if it has one.

    The group of an application has the name of the application, unless the file gives another one.
    """
    node, app = root.get("group"), root.get("app")
    group = None if node is None else validated(GroupInFile, node, problems, "group")
    if node is None or group is None:
        return tuple(specs)
    if not group.name and app is not None and isinstance(app.value, str):
        group = replace(group, name=app.value)
    _check(group, node, [spec.name for spec in specs], problems)
    return tuple(replace(spec, group=group.membership(spec.name)) for spec in specs)


def _check(group: GroupInFile, node: Node, there: Sequence[str], problems: Problems) -> None:
    check_name(node.get("name"), "group", problems)
    if not group.name:
        text = (
            "group.name is missing. Files with the same name are one group, so choose one that no "
            "other file of yours has by chance"
        )
        problems.add(node.place, text)
    if not group.ends_with and not group.fails_with:
        text = (
            "group: give `ends_with` or `fails_with`, the processes whose end cancels the others: "
            f"a name, a list of names, or `{_ANY}`"
        )
        problems.add(node.place, text)
    for key in ("ends_with", "fails_with"):
        for name in getattr(group, key):
            if name != _ANY and name not in there:
                text = f"group.{key}: no process {name!r} in this file; {_hint(name, there)}"
                problems.add(node.deepest((key,)).place, text)


def _hint(name: str, there: Sequence[str]) -> str:
    close = get_close_matches(name, there, 1)
    return f"did you mean {close[0]!r}?" if close else f"there are: {', '.join(few(there))}"
