"""Addresses of the installed plugins, commands and file checks, without loading them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

#: Entry-point group of the plugins.
GROUP: Final = "rosrm"
#: Entry-point group of additional commands of `rosrm`: name to function or `typer.Typer`.
COMMANDS: Final = "rosrm.commands"
#: Entry-point group of additional checks of `rosrm config check`: kind of file to function.
CHECKS: Final = "rosrm.checks"


@dataclass(frozen=True, slots=True)
class PluginAddress:
    """Address of an installed plugin.

    Attributes:
        name: name of its entry point.
        target: "module" or "module:object".
        distribution: name and version of its Python distribution.
    """

    name: str
    target: str
    distribution: str = ""


def installed_plugins(group: str = GROUP) -> list[PluginAddress]:
    """Return each entry point once, by name, even if a folder is on the path twice."""
    # Imported here, because a runtime must not load this module's readers of e-mail and zip files.
    from importlib.metadata import entry_points  # noqa: PLC0415 - see above

    found: dict[tuple[str, str], PluginAddress] = {}
    for point in entry_points(group=group):
        distribution = f"{point.dist.name} {point.dist.version}" if point.dist else ""
        address = PluginAddress(point.name, point.value, distribution)
        found.setdefault((distribution, point.name), address)
    return [found[key] for key in sorted(found)]
