"""Addresses of the installed plugins, commands and file checks; none of them is loaded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

#: Entry-point group of the plugins.
GROUP: Final = "rosrm"
#: Entry-point group of further commands of `rosrm`: name of the command, function or `typer.Typer`.
COMMANDS: Final = "rosrm.commands"
#: Entry-point group of the checks of `rosrm config check`: kind of file, function.
CHECKS: Final = "rosrm.checks"


@dataclass(frozen=True, slots=True)
class PluginAddress:
    """Address of an installed plugin.

    Attributes:
        name: of its entry point.
        target: "module" or "module:object".
        distribution: name and version of the package that brings it.
    """

    name: str
    target: str
    distribution: str = ""


def installed_plugins(group: str = GROUP) -> list[PluginAddress]:
    """Return each entry point once, by name, even where a folder is twice on the path."""
    # Entry points are read as e-mail headers in zip files. A runtime must not load those readers.
    from importlib.metadata import entry_points  # noqa: PLC0415 - see above

    found: dict[tuple[str, str], PluginAddress] = {}
    for point in entry_points(group=group):
        distribution = f"{point.dist.name} {point.dist.version}" if point.dist else ""
        address = PluginAddress(point.name, point.value, distribution)
        found.setdefault((distribution, point.name), address)
    return [found[key] for key in sorted(found)]
