"""Command `rosrm run`: one job without a file, as if it ran in this terminal."""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from typing import Annotated

import typer

from rosrm.cli import connection
from rosrm.cli.options import Domain, pairs_of, seconds_of
from rosrm.errors import ConfigError


def run(  # noqa: PLR0913, PLR0917 - an argument for each option
    ctx: typer.Context,
    command: Annotated[
        list[str] | None,
        typer.Argument(metavar="COMMAND...", help="Program and its arguments, after --."),
    ] = None,
    needs: Annotated[
        list[str] | None,
        typer.Option(
            "--needs", metavar="RESOURCE=AMOUNT",
            help="Amount of a resource, e.g. memory=200MB or cpu=0.5; repeatable.",
        ),
    ] = None,
    name: Annotated[
        str,
        typer.Option(
            "--name", metavar="NAME",
            help="Name of the job; default: that of the program with a random suffix.",
        ),
    ] = "",
    on: Annotated[
        list[str] | None,
        typer.Option(
            "--on", metavar="HOST|LABEL=VALUE",
            help="Only this host, or only hosts with this label; repeatable.",
        ),
    ] = None,
    env: Annotated[
        list[str] | None,
        typer.Option(
            "--env", metavar="NAME=VALUE",
            help="Environment variable of the job, e.g. MODE=fast; repeatable.",
        ),
    ] = None,
    time_limit: Annotated[
        str,
        typer.Option(
            "--time-limit", metavar="TIME",
            help="Stop the job after this time, e.g. 5min; default: no limit.",
        ),
    ] = "",
    directory: Annotated[
        str,
        typer.Option(
            "--working-directory", metavar="DIR",
            help="Working directory on the host, e.g. `.`; default: one of rosrm's own.",
        ),
    ] = "",
    patience: Annotated[
        str,
        typer.Option(
            "--master-timeout", metavar="TIME",
            help="Exit with 3 after the master was silent for this time; the job may continue. "
            "`never`: wait for the master without a bound.",
        ),
    ] = "10min",
    domain: Domain = None,
) -> None:  # fmt: skip
    """Run one job on a host, print its output here, and exit with its exit code.

    The job is queued as any other. Ctrl-C cancels it; a second Ctrl-C leaves it. The exit code is
    that of the job, or 128 + the number of the signal that ended it; 3 if the master was silent for
    `--master-timeout`. Standard input is not connected. Both output streams of the job arrive on
    the standard output.
    """
    from rosrm.cli.job_run import run_job
    from rosrm.cli.job_spec import job_of, placed

    spec = job_of(
        command or [], name=name, needs=pairs_of("--needs", needs or [], "RESOURCE=AMOUNT"),
        environment=pairs_of("--env", env or [], "NAME=VALUE"), time_limit=time_limit,
        directory=directory,
    )  # fmt: skip
    hint = ", or `never`"
    longest = None if patience == "never" else seconds_of("--master-timeout", patience, hint=hint)
    connection.warn_of_files([spec], "run")
    if any(not word or word.startswith("=") for word in on or []):
        raise ConfigError("--on: give the name of a host, or LABEL=VALUE")
    with connection.master(ctx, domain) as client:
        raise typer.Exit(run_job(client, placed(spec, on or [], client.list_hosts()), longest))
