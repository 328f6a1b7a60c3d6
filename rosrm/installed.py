"""Where the installed plugins are."""

from __future__ import annotations

from importlib.metadata import entry_points

from rosrm import hookspecs
from rosrm.handover import PluginAddress


def installed_plugins() -> list[PluginAddress]:
    """Each entry point once, in the order of names, even where a folder is twice on the path."""
    found: dict[tuple[str, str], PluginAddress] = {}
    for point in entry_points(group=hookspecs.GROUP):
        distribution = f"{point.dist.name} {point.dist.version}" if point.dist else ""
        address = PluginAddress(point.name, point.value, distribution)
        found.setdefault((distribution, point.name), address)
    return [found[key] for key in sorted(found)]
