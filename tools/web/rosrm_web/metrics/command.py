"""The command `rosrm metrics`."""

# What only some calls need is imported when they run, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rosrm import clocks
from rosrm.cli import connection
from rosrm.cli.options import Domain, seconds_of
from rosrm.cli.output.plain import echo
from rosrm.errors import ConfigError, NoMaster
from rosrm.runtime import durable
from rosrm.wording import reason_of

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.client.event_feed import EventFeed
    from rosrm.model.rows import Listing
    from rosrm_web.metrics.counting import EventMetrics

#: Mode of the file: the node exporter runs as another user.
_READABLE = 0o644


def metrics(
    ctx: typer.Context,
    textfile: Annotated[
        Path | None,
        typer.Option(
            "--textfile", metavar="FILE", help="Write FILE, e.g. rosrm.prom; default: print them."
        ),
    ] = None,
    every: Annotated[
        str,
        typer.Option(
            "--every", metavar="TIME", help="Repeat until Ctrl-C, e.g. 15s, and count events too."
        ),
    ] = "",
    domain: Domain = None,
) -> None:
    """Print metrics of the cluster for Prometheus.

    With --textfile, the textfile collector of the node exporter reads them. `rosrm web` serves the
    same metrics at /metrics.
    """
    from rosrm.client.event_feed import EventFeed
    from rosrm_web.metrics.counting import EventMetrics
    from rosrm_web.watching import MOST_EVENTS

    period = seconds_of("--every", every) if every else 0.0
    if every and textfile is None:
        raise ConfigError("--every: give the file too: --textfile FILE")
    with connection.master(ctx, domain) as client:
        counted = EventMetrics() if period else None
        after = client.list().last_sequence if period else 0

        def ask(after: int, newest: int) -> Listing:
            return client.list(
                hosts=True, processes=True, applications=True, plugins="failing",
                events=counted is not None, after=after, newest=min(newest, MOST_EVENTS),
            )  # fmt: skip

        feed = EventFeed(ask, after, MOST_EVENTS)
        trouble = ""
        while True:
            content = _look(client, feed, counted)
            try:
                _write(content, textfile)
                trouble = ""
            except ConfigError as error:
                if not period:
                    raise
                if str(error) != trouble:
                    echo(f"rosrm: {error}; the next attempt is in {period:g} s", err=True)
                trouble = str(error)
            if not period:
                return
            time.sleep(period)


def _look(client: Client, feed: EventFeed, counted: EventMetrics | None) -> bytes:
    """Return the metrics in the format of Prometheus.

    `counted`: counts the events of repeated calls; None: there is one call.
    """
    from rosrm_web.metrics.exposition import exposition

    begun = clocks.boot_time()
    try:
        events = list(feed.new())
    except NoMaster:
        if counted is None:
            raise
        return exposition(None, 0.0, counted)
    if counted is not None:
        counted.count(events)
    seconds = clocks.boot_time() - begun
    load = client.master_load() if counted is not None else {}
    return exposition(feed.listing, seconds, counted, load)


def _write(content: bytes, textfile: Path | None) -> None:
    if textfile is None:
        sys.stdout.write(content.decode())
        return
    try:
        # The new content is in *.new at first: the collector reads *.prom only.
        os.close(durable.replace_atomically(str(textfile), content, mode=_READABLE))
    except OSError as error:
        raise ConfigError(f"--textfile {textfile}: cannot be written: {reason_of(error)}") from None
