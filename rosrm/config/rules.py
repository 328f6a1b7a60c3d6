"""Rules of a file that no single value can break."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Final

from rosrm.config.documents import Node, Problems
from rosrm.extensions.units import ANY_AMOUNT, amount_of

_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}")


def check_name(node: Node | None, what: str, problems: Problems) -> None:
    """Names become names of files and topics."""
    if node is None or not isinstance(node.value, str) or _NAME.fullmatch(node.value):
        return
    problems.add(
        node.place,
        f"{node.value!r} cannot be the name of a {what}. Allowed: at most 200 letters, digits, "
        "'_', '-' and '.', the first of them a letter, digit or '_'",
    )


def check_amounts(
    node: Node | None, where: str, problems: Problems, *, above: bool = False
) -> None:
    """Amounts carry the units of their resource; a budget is above 0."""
    for resource, amount in (node.items if node else {}).items():
        try:
            ANY_AMOUNT.parse(amount.plain())
        except ValueError:
            continue  # no amount of anything: noted already
        try:
            value = amount_of(resource, amount.plain())
        except ValueError as error:
            problems.add(amount.place, f"{where}.{resource}: {error}")
            continue
        if above and value <= 0.0:
            problems.add(amount.place, f"{where}.{resource}: must be above 0")


def settled(directory: Path, file: str | Path) -> Path:
    """A directory that a file names: `~` is the user's, a relative one is beside the file."""
    return Path(file).absolute().parent / directory.expanduser()


def settled_on_host(path: str, file: str | Path) -> str:
    """Return a path for the host that runs a process.

    A relative path is beside the file. `~` stays for the slave, because the home of its user may
    be another one there.
    """
    return path if path.startswith("~") else os.path.normpath(Path(file).absolute().parent / path)
