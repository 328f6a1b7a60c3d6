"""`rosrm alerts`: alerts on a cluster, and where they are sent."""

# Each command imports what it needs when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rosrm import clocks
from rosrm.cli.options import Domain
from rosrm.cli.output.plain import echo
from rosrm.errors import ConfigError, RosrmError
from rosrm.runtime.dispositions import handled
from rosrm.wording import counted, listed

#: Seconds for the delivery of one notice by `try`.
_PATIENCE = 60.0

if TYPE_CHECKING:
    from rosrm.extensions.guarded_sink import GuardedSink
    from rosrm.extensions.registry import Registry
    from rosrm_alerts.alerts_file import AlertsFile, ChosenSink

alerts = typer.Typer(
    no_args_is_help=True, help="Alerts on events and readings, sent to other systems."
)

File = Annotated[Path, typer.Argument(metavar="FILE", help="alerts.yaml.")]


@alerts.callback()
def _group() -> None:
    """Alerts on events and readings, sent to other systems."""


@alerts.command()
def check(file: File) -> None:
    """Check a file, and run the tests that it has, without a cluster."""
    from rosrm.extensions.registry import Registry
    from rosrm_alerts.alerts_file import load_alerts
    from rosrm_alerts.rehearsal import differences

    loaded = load_alerts(file, Registry.discover())
    failed = 0
    for test in loaded.tests:
        found = differences(test, loaded.alerts)
        failed += bool(found)
        echo(f"{test.name}: {'failed' if found else 'ok'}")
        for line in found:
            echo(f"  {line}")
    if failed:
        raise RosrmError(f"{file}: {failed} of {counted(len(loaded.tests), 'test')} failed")
    numbers = {"alert": loaded.alerts, "sink": loaded.sinks, "test": loaded.tests}
    echo(f"{file}: ok, {listed(counted(len(of), noun) for noun, of in numbers.items())}")


@alerts.command("try")
def try_sink(
    file: File, sink: Annotated[str, typer.Argument(metavar="SINK", help="Name of a sink in FILE.")]
) -> None:
    """Send one notice to a sink, to see that it arrives."""
    from rosrm import Notice
    from rosrm.extensions.registry import Registry
    from rosrm_alerts.alerts_file import load_alerts

    registry = Registry.discover()
    chosen = {one.name: one for one in load_alerts(file, registry).sinks}
    if sink not in chosen:
        raise ConfigError(f"{file}: no sink {sink!r}; there are: {listed(chosen) or 'none'}")
    now = clocks.wall_time()
    notice = Notice(f"try-{now:.6f}", now, "try", "`rosrm alerts try` sent this notice")
    with _made(chosen[sink], registry) as guarded:
        guarded.send([notice], _PATIENCE)
    echo(f"the sink {sink} has taken the notice")


@alerts.command()
def run(
    ctx: typer.Context,
    file: File,
    state: Annotated[
        Path | None,
        typer.Option(
            "--state",
            metavar="DIR",
            help="Directory of notices that wait; default: ~/.local/state/rosrm/alerts/NAME "
            "for NAME.yaml.",
        ),
    ] = None,
    domain: Domain = None,
) -> None:
    """Watch the cluster until Ctrl-C, and send notices of alerts.

    A notice is on disk until its sink has taken it. With an unreachable sink it is sent again after
    1 s, 2 s, 4 s and so on, up to 5 min.
    """
    from rosrm import Client
    from rosrm.cli import connection
    from rosrm.config.settings import default_state
    from rosrm.extensions.registry import Registry
    from rosrm_alerts.alerts_file import load_alerts
    from rosrm_alerts.outbox import Outbox
    from rosrm_alerts.service import AlertService

    registry = Registry.discover()
    loaded = load_alerts(file, registry)
    settings = connection.ros_settings(ctx, domain)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    directory = state or default_state("alerts", file.stem)
    with ExitStack() as closing_all, _until_stopped() as stop:
        outbox = closing_all.enter_context(closing(Outbox(directory / "outbox.sqlite")))
        sinks = _all_sinks(loaded, registry)
        echo(
            f"watching for {counted(len(loaded.alerts), 'alert')}; "
            f"notices wait in {directory}; Ctrl-C ends", err=True,
        )  # fmt: skip
        AlertService(
            loaded, sinks, outbox, lambda: Client(ros=settings, notify=lambda _: None)
        ).run(stop)


def _all_sinks(file: AlertsFile, registry: Registry) -> dict[str, tuple[GuardedSink, int]]:
    return {
        one.name: (_made(one, registry), getattr(registry.offer("sink", one.use), "batch", 1))
        for one in file.sinks
    }


def _made(sink: ChosenSink, registry: Registry) -> GuardedSink:
    return registry.sink(sink.use, sink.options, sink.name)


@contextmanager
def _until_stopped() -> Iterator[threading.Event]:
    """Yield an event that SIGINT and SIGTERM set."""
    stop = threading.Event()
    with handled((signal.SIGINT, signal.SIGTERM), lambda *_: stop.set()):
        yield stop
