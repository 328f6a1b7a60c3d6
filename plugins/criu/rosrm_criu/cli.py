"""`rosrm criu check`: check of CRIU, which the strategy `criu` uses."""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rosrm.cli.options import AsJson

if TYPE_CHECKING:
    from rosrm_criu.engine.binary import CriuBinary
    from rosrm_criu.engine.probe import CriuSupport

criu = typer.Typer(
    no_args_is_help=True,
    help="Check CRIU, which moves a process with its whole memory.",
)

Prefix = Annotated[
    Path | None,
    typer.Option(
        "--prefix",
        metavar="FOLDER",
        help="Folder of CRIU; default: ROSRM_CRIU_PREFIX, or below the user's data.",
    ),
]


@criu.callback()
def _group() -> None:
    """Check CRIU, which moves a process with its whole memory."""


@criu.command()
def check(prefix: Prefix = None, as_json: AsJson = False) -> None:
    """Dump and restore a process on this machine, and report what works.

    The exit code is 0 only if it works, and images can be sent.
    """
    from rosrm.cli.output import json_forms
    from rosrm_criu.engine.binary import default_prefix
    from rosrm_criu.transfer import missing

    found, able = _tried((prefix or default_prefix()).absolute())
    lacking = missing()
    if as_json:
        program = found.command[0] if found else None
        json_forms.show({"program": program, "no_transfer": lacking, **asdict(able)})
    else:
        sent = (not lacking, "to other hosts", lacking or "images can be sent and fetched")
        for good, what, text in [*_lines(found, able), sent]:
            typer.echo(f"{'ok' if good else 'NO':4}{what:18}{text}")
    if lacking or not able.works:
        raise typer.Exit(1)


# --- inner parts ------------------------------------------------------------------------------


def _tried(prefix: Path) -> tuple[CriuBinary | None, CriuSupport]:
    """Return the CRIU to use on this machine, or None, and its capability."""
    from rosrm.errors import CriuError
    from rosrm_criu.engine.binary import find
    from rosrm_criu.engine.probe import CriuSupport, probe

    try:
        found = find(prefix)
    except CriuError as error:
        return None, CriuSupport(False, str(error), {})
    return found, probe(found)


def _lines(found: CriuBinary | None, able: CriuSupport) -> list[tuple[bool, str, str]]:
    """Return the lines of the report: success, subject, and result."""
    if found is None:
        return [(False, "program", able.reason)]
    from rosrm_criu.engine.binary import OLDEST

    facts = able.facts
    whose = "every user" if facts["all_users"] == "yes" else f"the user {facts['uid']} alone"
    enough = found.number >= OLDEST
    wanted = "" if enough else f" ({'.'.join(map(str, OLDEST))} or newer is meant)"
    text = "a process with a UDP socket was dumped, restored and went on" if able.works else ""
    python = f"{facts['python']} ({facts['python_version']}), {facts['libc']}"
    return [
        (True, "program", found.command[0]),
        (enough, "version", found.version + wanted),
        (True, "processes", f"of {whose}"),
        (able.works, "dump and restore", text or able.reason),
        (True, "kernel", f"{facts['kernel']} on {facts['machine']}"),
        (
            True,
            "same elsewhere",
            f"Python {python}, {len(facts['cpu'].split())} processor features",
        ),
    ]
