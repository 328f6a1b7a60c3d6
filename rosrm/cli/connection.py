"""How a command reaches the master. ROS is imported here, and not before a command needs it."""

from __future__ import annotations

import getpass
import os
import socket
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import typer

from rosrm.cli import early
from rosrm.cli.options import Common
from rosrm.cli.process import BEGUN
from rosrm.errors import Refused, RosrmError
from rosrm.model.ros_settings import RosSettings
from rosrm.wording import no_such

if TYPE_CHECKING:
    from rosrm.model.rows import Snapshot
    from rosrm.ros.client import MasterClient

#: Seconds from the start of the command within which it says that there is no master: less than 3,
#: for leaving ROS takes a moment too.
SAID_WITHIN: Final = 2.6
#: However long the imports took, a master on this machine is found in this time.
LEAST: Final = 1.5


def ros_settings(ctx: typer.Context, domain: int | None) -> RosSettings:
    """How to join ROS: the command's own option, before the common ones, before the file."""
    common = ctx.obj if isinstance(ctx.obj, Common) else Common()
    settings = RosSettings()
    if common.cluster is not None:
        from rosrm.config import load_cluster  # noqa: PLC0415 - pydantic only where a file is read

        settings = load_cluster(common.cluster).ros
    chosen = common.domain if domain is None else domain
    return settings if chosen is None else replace(settings, domain=chosen)


@contextmanager
def master(ctx: typer.Context, domain: int | None) -> Iterator[MasterClient]:
    """A connection to the master for one command."""
    with connect(ros_settings(ctx, domain)) as client:
        yield client


def say_trouble(snapshot: Snapshot) -> None:
    """Tell people beside the listing that the master takes no new work, and why."""
    if snapshot.trouble:
        typer.echo(f"rosrm: {snapshot.trouble}", err=True)


def check_name(kind: str, name: str, known: Iterable[str]) -> None:
    """Refuse a name that is not among the known ones, with those meant; "" is no name.

    Args:
        kind: "process" or "host".
        name: from the command line.
        known: names that the master has.
    """
    names = list(known)
    if not name or name in names:
        return
    raise Refused(no_such(kind, [name], names), "unknown")


def connect(settings: RosSettings) -> MasterClient:
    """Find the master; raises `NoMaster`, or `RosrmError` where there is no ROS 2."""
    try:
        from rosrm.ros.client import MasterClient  # noqa: PLC0415 - the first import of ROS
    except ImportError as error:
        if (error.name or "").split(".")[0] == "rosrm":
            raise
        reason = str(error).splitlines()[0]
        raise RosrmError(
            f"ROS 2 cannot be imported ({reason}). Source your ROS 2 (and the workspace with "
            "rosrm_msgs), or install the wheels: pip install 'rosrm[ros]'"
        ) from None
    timeout = max(LEAST, SAID_WITHIN - (time.monotonic() - BEGUN))
    who = f"{getpass.getuser()}@{socket.gethostname()}:{os.getpid()}"
    return MasterClient.connect(
        settings, name=who, timeout=timeout, joined=early.take(settings), begun=BEGUN
    )
