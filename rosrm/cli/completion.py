"""Values for the completion of a shell: names of processes, hosts and applications.

A completion prints names or nothing: it neither reports an error nor waits for a master that is
silent.
"""

# The command line imports this module, and only a completion needs the rest.
# ruff: noqa: PLC0415

from __future__ import annotations

import os
import threading
from typing import TYPE_CHECKING, Final

import typer

from rosrm import clocks
from rosrm.cli import early

if TYPE_CHECKING:
    from rosrm.model.rows import Listing

#: Seconds for finding a master, and again for its answer.
LIMIT: Final = 0.3
#: Seconds after which the process ends, whatever it waits for.
_LAST_RESORT: Final = 2.0


def processes(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the names of processes that begin with a text."""
    return [one.name for one in _listing(ctx).processes if one.name.startswith(incomplete)]


def hosts(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the names of hosts that begin with a text."""
    found = [one.description.name for one in _listing(ctx).hosts]
    return [name for name in found if name.startswith(incomplete)]


def applications(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the names of applications that begin with a text."""
    return [one.name for one in _listing(ctx).applications if one.name.startswith(incomplete)]


def _listing(ctx: typer.Context) -> Listing:
    """Return the listings of the master; empty ones if it cannot be asked, or does not answer."""
    from rosrm.model.rows import Listing

    _silence_errors()
    last_resort = threading.Timer(_LAST_RESORT, os._exit, (0,))
    last_resort.daemon = True
    last_resort.start()
    try:
        return _asked(ctx)
    except Exception:  # noqa: BLE001 - a completion reports nothing
        return Listing("", 0.0, 0)
    finally:
        last_resort.cancel()


def _silence_errors() -> None:
    """Drop messages of this process, because they would appear in the command line."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


def _asked(ctx: typer.Context) -> Listing:
    from rosrm.client import connecting

    given = {**ctx.find_root().params, **{k: v for k, v in ctx.params.items() if v is not None}}
    settings = connecting.ros_settings(given.get("domain"), given.get("cluster"))
    security = connecting.security_mode(given.get("cluster"))
    joined = early.take(settings)
    with connecting.connect(settings, timeout=LIMIT, security=security, joined=joined) as client:
        deadline = clocks.boot_time() + LIMIT

        def check(_waited: float) -> None:
            if clocks.boot_time() > deadline:
                raise TimeoutError

        return client.list(processes=True, hosts=True, applications=True, on_wait=check)
