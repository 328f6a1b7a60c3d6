"""The tree of commands, and how errors become messages and exit codes.

======  ===========================================================
exit    when
======  ===========================================================
0       it was done
1       it was refused, or failed
2       a file, option or argument is wrong; nothing was done
3       no master (or slave) answered
130     Ctrl-C
======  ===========================================================
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated, Any

import typer

from rosrm.cli import simulate
from rosrm.cli.commands import change, check, follow, inspect, start
from rosrm.cli.groups import PlainCommand, PlainGroup, hint_after
from rosrm.cli.lab import lab
from rosrm.cli.options import Common, Domain
from rosrm.cli.process import INTERRUPTED
from rosrm.errors import RosrmError
from rosrm.version import PROTOCOL_VERSION, __version__


class Guarded(PlainGroup):
    """Says what a user did wrong without a traceback."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command; a verb that other tools have gets the name of ours."""
        hint = "" if args[0] in self.commands else hint_after(args[0])
        if hint:
            ctx.fail(f"No such command {args[0]!r}. {hint}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run the command; turn our own errors into a message and an exit code."""
        try:
            return super().invoke(ctx)
        except RosrmError as error:
            typer.echo(f"rosrm: {error}", err=True)
            raise typer.Exit(error.exit_code) from None
        except KeyboardInterrupt:
            raise typer.Exit(INTERRUPTED) from None


app = typer.Typer(
    cls=Guarded,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"rosrm {__version__} (protocol {PROTOCOL_VERSION})")
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
            help="A cluster.yaml: its `ros` section says how to reach the master.",
        ),
    ] = None,
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Decides on which host each process of a ROS 2 application runs, and keeps it running."""
    del version  # its callback has done all
    ctx.obj = Common(domain, cluster)


for module in (start, change, inspect, follow, simulate):
    for function in module.COMMANDS:
        app.command()(function)
groups = {"config": check.config, "lab": lab}
# Until commands come by the entry points `rosrm.commands`, which plugins/criu names already.
with contextlib.suppress(ModuleNotFoundError):
    from rosrm_criu.cli import criu

    groups["criu"] = criu
for name, group in groups.items():
    app.add_typer(group, name=name, cls=PlainGroup)
for group in (app, *groups.values()):
    for command in group.registered_commands:
        command.cls = PlainCommand
