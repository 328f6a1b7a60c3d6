"""Command `rosrm plugin new`: the package of a new plugin."""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from rosrm.cli.output.plain import echo

plugin = typer.Typer(no_args_is_help=True, help="Write plugins.")


class Kind(str, Enum):
    """Kinds of plugins with a template."""

    SCORING = "scoring"
    FILTER = "filter"
    PROBE = "probe"
    MIGRATION = "migration"
    CHECKPOINT = "checkpoint"


@plugin.callback()
def _group() -> None:
    """Write plugins."""


@plugin.command()
def new(
    kind: Annotated[
        Kind,
        typer.Argument(metavar="KIND", help="scoring, filter, probe, migration or checkpoint."),
    ],
    name: Annotated[
        str,
        typer.Argument(metavar="NAME", help="Name of the plugin in configuration files."),
    ],
    into: Annotated[
        Path,
        typer.Option(
            "--into", metavar="DIR", help="Folder for the package; default: the current one."
        ),
    ] = Path(),
) -> None:
    """Write the package of a new plugin: rosrm-NAME.

    The package is a small working plugin with its tests and a configuration file.
    """
    from rosrm.cli.new_plugin import create_package
    from rosrm.extensions.registry import Registry

    folder = create_package(kind.value, name, into, Registry.discover())
    files = sorted(path.name for path in folder.iterdir())
    echo(f"created {folder}: {', '.join(files)}")
    checks = " ".join(file for file in files if file.endswith(".yaml"))
    echo(f"next: cd {folder}; pip install .; python -m pytest; rosrm config check {checks}")
