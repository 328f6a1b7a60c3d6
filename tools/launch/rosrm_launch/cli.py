"""`rosrm launch`: a launch file of ROS 2 as an application."""

# What only some calls need is imported when they run, so that `rosrm launch --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rosrm.cli.commands.applications import NoWait, carry_out
from rosrm.cli.commands.change import Timeout
from rosrm.cli.options import AsJson, Domain, seconds_of
from rosrm.cli.output.plain import echo
from rosrm.errors import ConfigError

if TYPE_CHECKING:
    from rosrm.config.documents import Node
    from rosrm.model.applications import Target
    from rosrm_launch.model import Argument, Omission
    from rosrm_launch.translate import Translation

_RESOLVE_TIMEOUT: Final = "60s"


def launch(  # noqa: PLR0913, PLR0917 - an argument for each option
    ctx: typer.Context,
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="[PACKAGE] FILE [NAME:=VALUE...]",
            help="Launch file, or package and name of its launch file; then arguments, e.g. "
            "map:=x.yaml.",
        ),
    ],
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Show each process, its host and why, and begin nothing; exit 2 if anything would "
            "change, 0 if not.",
        ),
    ] = False,
    as_yaml: Annotated[
        bool, typer.Option("--yaml", help="Print a work file for `rosrm apply`, without a master.")
    ] = False,
    show_args: Annotated[
        bool, typer.Option("--show-args", help="List the arguments of the launch file.")
    ] = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Refuse a file of which a part cannot be translated.")
    ] = False,
    application: Annotated[
        str,
        typer.Option(
            "--app", metavar="NAME", help="Name of the application; default: that of the file."
        ),
    ] = "",
    beside: Annotated[
        str,
        typer.Option(
            "--with",
            metavar="FILE",
            help="Settings of rosrm by node; default: robot.rosrm.yaml beside robot.launch.py.",
        ),
    ] = "",
    resolve_timeout: Annotated[
        str,
        typer.Option(
            "--resolve-timeout", metavar="TIME", help="Longest time to resolve it; default: 60s."
        ),
    ] = _RESOLVE_TIMEOUT,
    no_wait: NoWait = False,
    timeout: Timeout = "",
    as_json: AsJson = False,
    domain: Domain = None,
) -> None:
    """Run the processes of a ROS 2 launch file on the hosts of the cluster.

    The file is resolved on this machine, which needs `launch` and `launch_ros` of a ROS
    installation, and becomes an application: `rosrm apps`, `history`, `revert` and `cancel --app`
    apply to it. What cannot be translated is listed.
    """
    from rosrm_launch.running import launch_file, resolve
    from rosrm_launch.translate import translated

    limit = seconds_of("--resolve-timeout", resolve_timeout)
    arguments = [word for word in words if ":=" in word]
    file = launch_file([word for word in words if ":=" not in word])
    model = resolve(file, arguments, timeout=limit, show_arguments=show_args)
    if show_args:
        _show_arguments(model.arguments)
        return
    translation = translated(model, application)
    _show_omissions(translation)
    if strict and translation.omissions:
        raise ConfigError(f"{file}: --strict refuses what cannot be translated, as listed above")
    work, target = _target(translation, file, beside)
    if as_yaml:
        _show_yaml(work)
        return

    carry_out(
        ctx, [target.application], lambda client: partial(client.apply_targets, [target]),
        domain, timeout, plan=dry_run, no_wait=no_wait, as_json=as_json,
    )  # fmt: skip


def _target(translation: Translation, file: Path, beside: str) -> tuple[Node, Target]:
    """Return the work file and its checked application, with the settings of the file beside."""
    from rosrm.config.work import checked_work
    from rosrm.extensions.registry import Registry
    from rosrm_launch.beside import completed, path_beside

    settings = Path(beside) if beside else path_beside(file)
    known = settings if beside or settings.is_file() else None
    work = completed(translation, file, known)
    return work, checked_work(work, file, Registry.discover())


def _show_arguments(arguments: Sequence[Argument]) -> None:
    if not arguments:
        echo("the launch file declares no arguments")
    for one in arguments:
        given = "must be given" if one.default is None else f"default: {one.default!r}"
        choices = f"; one of {', '.join(one.choices)}" if one.choices else ""
        echo(f"{one.name}:=  ({given}{choices})")
        echo(f"    {one.description}")


def _show_omissions(translation: Translation) -> None:
    """Print what was not translated, and what a user should know, to standard error."""
    omissions: Sequence[Omission] = translation.omissions
    for one in omissions:
        echo(f"rosrm: not translated: {one}", err=True)
    for note in translation.notes:
        echo(f"rosrm: note: {note}", err=True)


def _show_yaml(work: Node) -> None:
    import yaml

    for line in yaml.safe_dump(work.plain(), sort_keys=False, allow_unicode=True).splitlines():
        echo(line)
