"""Commands of other distributions, found by the entry-point group `rosrm.commands`.

A search for entry points reads the metadata of every installed distribution, and a listing imports
the commands. To stay quick, rosrm's own commands do neither.
"""

from __future__ import annotations

from collections.abc import Sequence
from pkgutil import resolve_name
from typing import Any

import typer

from rosrm.cli.groups import PlainCommand, add_command
from rosrm.errors import PluginError, describe_plugin_fault
from rosrm.extensions.installed import COMMANDS, PluginAddress, installed_plugins
from rosrm.wording import listed


def find_commands() -> dict[str, list[PluginAddress]]:
    """Return the addresses of the commands of other distributions, by name in order."""
    found: dict[str, list[PluginAddress]] = {}
    for address in sorted(installed_plugins(COMMANDS), key=lambda one: one.name):
        found.setdefault(address.name, []).append(address)
    return found


def load_command(name: str, addresses: Sequence[PluginAddress]) -> Any:
    """Import a command; if that fails, return a command that raises `PluginError` when called.

    Args:
        name: name of the command.
        addresses: addresses of all commands of that name; at least one.
    """
    if len(addresses) > 1:
        brought_by = listed([one.distribution for one in addresses])
        return _unusable(name, f"the command {name!r} is in {brought_by}; uninstall all but one")
    (address,) = addresses
    alone = typer.Typer(add_completion=False, rich_markup_mode=None)
    try:
        add_command(alone, name, resolve_name(address.target))
        return typer.main.get_group(alone).commands[name]
    except (Exception, SystemExit) as fault:  # noqa: BLE001 - code of another distribution
        reason = describe_plugin_fault(fault)
    return _unusable(
        name, f"the command {name!r} of {address.distribution} cannot be loaded: {reason}"
    )


def _unusable(name: str, reason: str) -> Any:
    def refuse() -> None:
        raise PluginError(reason)

    anything = {"ignore_unknown_options": True, "allow_extra_args": True}
    return PlainCommand(
        name, callback=refuse, short_help=reason, add_help_option=False, context_settings=anything
    )
