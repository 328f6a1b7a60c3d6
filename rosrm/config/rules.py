"""Rules on names and amounts in a file, and resolution of paths relative to the file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from rosrm.config.documents import Node, Place, Problems
from rosrm.extensions.units import ANY_AMOUNT, amount_of
from rosrm.model.description_checks import name_fault
from rosrm.model.placeholders import ARTIFACTS


def check_name(node: Node | None, what: str, problems: Problems) -> None:
    """Note a name that is not allowed in file names and topics."""
    if node is None or not isinstance(node.value, str):
        return
    fault = name_fault(node.value, what)
    if fault:
        problems.add(node.place, fault)


def refuse_namesakes(nodes: Sequence[Node], what: str, problems: Problems) -> None:
    """Note every duplicate name in a list of entries.

    Args:
        nodes: the entries.
        what: kind of the entries, for messages.
        problems: receives every problem.
    """
    first: dict[str, Place] = {}
    for node in nodes:
        name = node.get("name")
        if name is None or not isinstance(name.value, str):
            continue
        before = first.get(name.value)
        if before is None:
            first[name.value] = name.place
        elif before == name.place:
            text = f"foreach gives every {what} the name {name.value!r}; use one of its names in it"
            problems.add(name.place, text)
        else:
            where = f"first given at line {before.line}, column {before.column}"
            problems.add(name.place, f"duplicate {what} name {name.value!r}, {where}")


def check_amounts(
    node: Node | None, where: str, problems: Problems, *, above: bool = False
) -> None:
    """Note amounts with a unit of another resource; with `above`, also amounts that are not > 0."""
    for resource, amount in (node.items if node else {}).items():
        try:
            ANY_AMOUNT.parse(amount.plain())
        except ValueError:
            continue  # not an amount, which was noted before
        try:
            value = amount_of(resource, amount.plain())
        except ValueError as error:
            problems.add(amount.place, f"{where}.{resource}: {error}")
            continue
        if above and value <= 0.0:
            problems.add(amount.place, f"{where}.{resource}: must be above 0")


def settled(directory: Path, file: str | Path) -> Path:
    """Return a directory with `~` expanded; a relative one is joined to the file's directory."""
    return Path(file).absolute().parent / directory.expanduser()


def settled_on_host(path: str, file: str | Path) -> str:
    """Return a path for the host that runs a process.

    A relative path is joined to the file's directory. `~` stays for the slave, because the home of
    its user may differ there, and so do `{artifacts}` and the directories of ROS packages.
    """
    if path.startswith(("~", f"{{{ARTIFACTS}}}", "$(find-pkg-")):
        return path
    return os.path.normpath(Path(file).absolute().parent / path)
