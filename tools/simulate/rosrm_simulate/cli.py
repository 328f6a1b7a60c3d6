"""`rosrm simulate`: a workload under other policies, weights and hosts."""

# Each command imports what it needs when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rosrm.cli.options import AsJson


def simulate(  # noqa: PLR0913, PLR0917 - an argument for each option
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="A workload (YAML), or the record of a master's run."),
    ],
    variants: Annotated[
        Path | None,
        typer.Option("--variants", metavar="FILE", help="YAML: a list of `variants` to compare."),
    ] = None,
    variant: Annotated[
        list[str] | None,
        typer.Option(
            "--variant",
            metavar="YAML",
            help="Add a variant, such as 'scoring: {policy: threshold}'.",
        ),
    ] = None,
    policy: Annotated[
        list[str] | None,
        typer.Option("--policy", metavar="NAME", help="Add a variant with this scoring policy."),
    ] = None,
    hosts: Annotated[
        list[int] | None,
        typer.Option("--hosts", metavar="N", help="Add a variant with so many hosts."),
    ] = None,
    until: Annotated[
        str,
        typer.Option(
            "--until", metavar="TIME", help="End each run after this time, such as 10min."
        ),
    ] = "",
    seed: Annotated[
        int | None,
        typer.Option(
            "--seed", metavar="N", min=0, help="Seed of the random values; default: the workload's."
        ),
    ] = None,
    cut: Annotated[bool, typer.Option("--cut", help="Accept a record that is cut short.")] = False,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Check the invariants of the master's core after each step; slower."
        ),
    ] = False,
    plot: Annotated[
        Path | None,
        typer.Option("--plot", metavar="FILE", help="Draw the runs: .png, .svg or .pdf."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Run a workload on virtual time, and compare policies, weights and numbers of hosts.

    The first row is the workload as given; each variant adds a row. The first row of a record is
    the real run.
    """
    from rosrm_simulate import picture, tables
    from rosrm_simulate.runs import SimulationRequest, carry_out

    if plot is not None:
        picture.check(plot)
    request = SimulationRequest(
        file, variants, tuple(variant or ()), tuple(policy or ()), tuple(hosts or ()), until, seed,
        cut, check,
    )  # fmt: skip
    report = carry_out(request)
    if plot is not None:
        picture.draw(report, plot)
    if as_json:
        from rosrm.cli.output.json_forms import show

        show(tables.report_form(report))
        return
    tables.show(report)
    if plot is not None:
        typer.echo(f"drawn: {plot}")
