"""Commands of other distributions, found by the entry-point group `rosrm.commands`.

A search for entry points reads the metadata of every installed distribution, and a listing imports
the commands. To stay quick, rosrm's own commands do neither.
"""

from __future__ import annotations

import errno
import os
import sys
import traceback
from collections.abc import Container, Sequence
from contextlib import redirect_stdout
from pkgutil import resolve_name
from typing import Any, Final

import typer

from rosrm.cli.groups import CommandLineError, PlainCommand, add_command
from rosrm.errors import PluginError, RosrmError, describe_plugin_fault
from rosrm.extensions.guard import guarded
from rosrm.extensions.installed import COMMANDS, PluginAddress, installed_plugins
from rosrm.model.rows import PluginRow
from rosrm.runtime.durable import NO_ROOM
from rosrm.wording import listed

#: Seconds for the import of a command; nothing but the command waits for it.
_LOADING: Final = 60.0
#: Errors of writing the output, which the entry point of the command reports.
_OF_OUTPUT: Final = (errno.EPIPE, *NO_ROOM)
#: What ends a command that works. A command that defers Ctrl-C raises `KeyboardInterrupt` itself.
_NO_FAULT: Final = (
    RosrmError, typer.Exit, typer.Abort, CommandLineError, SystemExit, KeyboardInterrupt,
)  # fmt: skip


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

    def load() -> Any:
        with redirect_stdout(sys.stderr):  # `rosrm COMMAND --json` prints nothing else
            add_command(alone, name, resolve_name(address.target))
        return _guarded(typer.main.get_group(alone).commands[name], address)

    try:
        return guarded(load, whom=f"the command {name!r}", hook="import", seconds=_LOADING)
    except PluginError as fault:
        reason = str(fault)
    return _unusable(
        name, f"the command {name!r} of {address.distribution} cannot be loaded: {reason}"
    )


def ignored_commands(own: Container[str]) -> list[PluginRow]:
    """Return a row for each command of another distribution with the name of one of rosrm's own."""
    reason = "its command is ignored, because rosrm has one of this name: rename its entry point"
    return [
        PluginRow("plugin", address.name, address.distribution, "broken", reason)
        for name, addresses in find_commands().items()
        if name in own
        for address in addresses
    ]


def _guarded(command: Any, address: PluginAddress) -> Any:
    """Return a command whose exceptions become an error with the distribution and the place."""
    invoke = command.invoke

    def guarded(ctx: Any) -> Any:
        try:
            return invoke(ctx)
        except _NO_FAULT:
            raise
        except BaseException as fault:
            if isinstance(fault, OSError) and fault.errno in _OF_OUTPUT:
                raise
            if os.environ.get("ROSRM_TRACEBACK"):
                traceback.print_exc()
            raise PluginError(
                f"the command {address.name!r} of {address.distribution} failed: "
                f"{describe_plugin_fault(fault)}; ROSRM_TRACEBACK=1 shows the whole traceback"
            ) from fault

    command.invoke = guarded
    return command


def _unusable(name: str, reason: str) -> Any:
    def refuse() -> None:
        raise PluginError(reason)

    anything = {"ignore_unknown_options": True, "allow_extra_args": True}
    return PlainCommand(
        name, callback=refuse, short_help=reason, add_help_option=False, context_settings=anything
    )
