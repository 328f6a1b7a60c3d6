"""Tree of commands, and conversion of errors into messages and exit codes.

======  ===========================================================
exit    when
======  ===========================================================
0       the command succeeded
1       the master refused the request, or the command failed
2       a file, option or argument is wrong; nothing was done
3       no master (or slave) answered
130     Ctrl-C
======  ===========================================================
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.models import CommandInfo

from rosrm.cli.commands import (
    adopt,
    applications,
    change,
    check,
    follow,
    inspect,
    key,
    logs,
    modes,
    plugin,
    run,
    runtimes,
    service,
    up,
)
from rosrm.cli.groups import DISTRIBUTIONS, PlainCommand, PlainGroup, add_command, hint_after
from rosrm.cli.installed_commands import find_commands, load_command
from rosrm.cli.options import CommonOptions, Domain
from rosrm.cli.output.plain import echo, errors_reported
from rosrm.errors import ConfigError
from rosrm.extensions.installed import PluginAddress
from rosrm.version import PROTOCOL_VERSION, __version__


class RootGroup(PlainGroup):
    """Root group: reports user errors without a traceback, and includes installed commands."""

    @cached_property
    def _installed(self) -> dict[str, list[PluginAddress]]:
        """Return the commands of other distributions, except those with a name of rosrm's own."""
        return {name: one for name, one in find_commands().items() if name not in self.commands}

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of all commands, rosrm's own first."""
        return [*super().list_commands(ctx), *self._installed]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command, imported now if it is of another distribution; None if unknown."""
        own = super().get_command(ctx, cmd_name)
        if own is None and cmd_name in self._installed:
            return load_command(cmd_name, self._installed[cmd_name])
        return own

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command; for an unknown one suggest a similar command."""
        word = args[0]
        if not (word in self.commands or word in self._installed or ctx.resilient_parsing):
            if word in DISTRIBUTIONS:
                raise ConfigError(
                    f"the command {word!r} comes with `pip install {DISTRIBUTIONS[word]}`"
                )
            hint = hint_after(word, self.list_commands(ctx))
            if hint:
                ctx.fail(f"No such command {word!r}. {hint}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run the command; turn our own errors into a message and an exit code."""
        with errors_reported():
            return super().invoke(ctx)


app = typer.Typer(
    cls=RootGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        echo(f"rosrm {__version__} (protocol {PROTOCOL_VERSION})")
        raise typer.Exit


@app.callback()
def common(
    ctx: typer.Context,
    domain: Domain = None,
    cluster: Annotated[
        Path | None,
        typer.Option(
            "--cluster",
            metavar="FILE",
            envvar="ROSRM_CLUSTER",
            help="A cluster.yaml; its section `ros` has the settings to reach the master.",
        ),
    ] = None,
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Place the processes of a ROS 2 application on hosts, and keep them running."""
    del version  # handled by its callback
    ctx.obj = CommonOptions(domain, cluster)


for module in (up, runtimes, applications, modes, change, adopt, inspect, follow, logs):
    for function in module.COMMANDS:
        app.command(cls=PlainCommand)(function)
app.command(cls=PlainCommand, context_settings={"allow_interspersed_args": False})(run.run)
app.command(cls=PlainCommand, context_settings={"ignore_unknown_options": True})(runtimes.container)
add_command(app, "config", check.config)
add_command(app, "key", key.key)
add_command(app, "plugin", plugin.plugin)
add_command(app, "service", service.service)


def keep_only(arguments: Sequence[str]) -> None:
    """Drop all commands but the one that the first argument names, if it names one.

    typer builds the types of all parameters of all commands: 40 ms.
    """
    name = next(iter(arguments), "")
    named = [one for one in app.registered_commands if _name_of(one) == name]
    if named:
        app.registered_commands[:], app.registered_groups[:] = named, []


def _name_of(command: CommandInfo) -> str:
    """Return the name of a command, by default that of its function."""
    function = command.callback.__name__ if command.callback is not None else ""
    return command.name or function.replace("_", "-")
