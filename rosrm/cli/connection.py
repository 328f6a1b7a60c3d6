"""Connection of a command to the master."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import typer

from rosrm.cli import early
from rosrm.cli.options import CommonOptions
from rosrm.cli.output.plain import echo
from rosrm.cli.process import BEGUN
from rosrm.client import connecting
from rosrm.model.ros_settings import RosSettings

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.model.rows import Listing
    from rosrm.ros.master_connection import MasterClient

#: Seconds from the start of the command until the message that there is no master: less than 3,
#: because leaving ROS takes time too.
SAID_WITHIN: Final = 2.6
#: Seconds for finding a master on this machine, counted after the imports.
LEAST: Final = 1.5


def ros_settings(ctx: typer.Context, domain: int | None) -> RosSettings:
    """Return the settings with which to join ROS.

    The option of the command comes before the common options, and these before the file.
    """
    common = ctx.obj if isinstance(ctx.obj, CommonOptions) else CommonOptions()
    chosen = common.domain if domain is None else domain
    return connecting.ros_settings(chosen, common.cluster)


@contextmanager
def master(ctx: typer.Context, domain: int | None) -> Iterator[Client]:
    """Create a client of the master for one command."""
    from rosrm.client.client import Client  # noqa: PLC0415 - `rosrm --help` has no use for it

    with Client(connection=connect(ros_settings(ctx, domain)), notify=note) as client:
        yield client


def note(text: str) -> None:
    """Print a sentence about the progress of the command to standard error."""
    echo(f"rosrm: {text}", err=True)


def say_trouble(snapshot: Listing) -> None:
    """Print beside the listing that the master accepts no new work, and why."""
    if snapshot.trouble:
        note(snapshot.trouble)


def connect(settings: RosSettings) -> MasterClient:
    """Find the master within `SAID_WITHIN` s of the command's start, but in at least `LEAST` s."""
    timeout = max(LEAST, SAID_WITHIN - (time.monotonic() - BEGUN))
    return connecting.connect(settings, timeout=timeout, joined=early.take(settings), begun=BEGUN)
