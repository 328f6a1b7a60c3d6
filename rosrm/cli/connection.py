"""Connection of a command to the master."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

import typer

from rosrm import clocks
from rosrm.cli import early
from rosrm.cli.options import CommonOptions
from rosrm.cli.output.plain import echo
from rosrm.cli.process import BEGUN
from rosrm.client import connecting
from rosrm.model.ros_settings import RosSettings

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.keys.roles import SecurityMode
    from rosrm.model.rows import Listing
    from rosrm.model.values import ProcessSpec
    from rosrm.ros.master_connection import MasterClient

#: Seconds from the start of the command until the message that no master answers. The command ends
#: within 3 s, and leaving ROS takes time too.
REPORT_WITHIN: Final = 2.6
#: Shortest time, in seconds, for finding a master, counted after the imports.
SHORTEST_SEARCH: Final = 1.5


def ros_settings(ctx: typer.Context, domain: int | None) -> RosSettings:
    """Return the ROS settings of the command.

    An option of the command overrides the common options, which override the file.
    """
    common = ctx.obj if isinstance(ctx.obj, CommonOptions) else CommonOptions()
    chosen = common.domain if domain is None else domain
    return connecting.ros_settings(chosen, common.cluster)


@contextmanager
def master(ctx: typer.Context, domain: int | None) -> Iterator[Client]:
    """Create a client of the master for one command."""
    from rosrm.client.client import Client  # noqa: PLC0415 - `rosrm --help` has no use for it

    cluster = ctx.obj.cluster if isinstance(ctx.obj, CommonOptions) else None
    security = connecting.security_mode(cluster)
    with Client(connection=connect(ros_settings(ctx, domain), security), notify=note) as client:
        yield client


def note(text: str) -> None:
    """Print a sentence about the progress of the command to standard error."""
    echo(f"rosrm: {text}", err=True)


def warn_of_files(specs: Iterable[ProcessSpec], path: str | Path) -> None:
    """Print a warning for each process that will not find a file beside its work file."""
    from rosrm.config.misplaced_files import misplaced_files  # noqa: PLC0415 - only with processes

    for text in misplaced_files(specs, path):
        note(f"warning: {text}")


def print_trouble(snapshot: Listing) -> None:
    """Print to standard error why the master accepts no new work, if it does not."""
    if snapshot.trouble:
        note(snapshot.trouble)


def connect(settings: RosSettings, security: SecurityMode | None = None) -> MasterClient:
    """Find the master within `REPORT_WITHIN` of the start, but for at least `SHORTEST_SEARCH`."""
    timeout = max(SHORTEST_SEARCH, REPORT_WITHIN - (clocks.boot_time() - BEGUN))
    return connecting.connect(
        settings, timeout=timeout, security=security, joined=early.take(settings), begun=BEGUN
    )
