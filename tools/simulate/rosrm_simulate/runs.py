"""Runs of `rosrm simulate`: read the file, run every variant, compare."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from pathlib import Path
from typing import Final

from rosrm import clocks
from rosrm.config.documents import Node
from rosrm.config.placement import chain_of, placement_of
from rosrm.config.settings import ClusterConfig
from rosrm.core.master.commands import Command
from rosrm.core.master.invariants import check
from rosrm.core.master.master_state import MasterState
from rosrm.errors import ConfigError, RecordError, RosrmError
from rosrm.extensions.contracts import MigrationStrategy
from rosrm.extensions.declared_fields import Declared
from rosrm.extensions.placement import PlacementPlugins
from rosrm.extensions.registry import Registry
from rosrm.extensions.units import Quantity
from rosrm.recording.encoding import Happened
from rosrm.recording.frames import is_record
from rosrm.recording.reader import Recording, read_record
from rosrm.wording import reason_of
from rosrm_simulate.agreement import Agreement, compare
from rosrm_simulate.engine import Progress, Simulation
from rosrm_simulate.extraction import Extraction
from rosrm_simulate.meter import Outcome
from rosrm_simulate.replay import Replay, Watcher, replay
from rosrm_simulate.variants import (
    Variant,
    load_variants,
    read_variants,
    settings_node,
    variant_in_text,
    variant_of_option,
)
from rosrm_simulate.workload import Workload
from rosrm_simulate.workload_file import load_workload

#: Seconds after which progress is shown.
_SHOWN_AFTER: Final = 2.0
_LONGEST_OPENING: Final = 64
#: Of so many steps without a command, one is checked.
_CHECKED: Final = 100


@dataclass(frozen=True, slots=True)
class SimulationRequest:
    """The arguments of the command line; the fields are its options."""

    file: Path
    variants: Path | None = None
    variant: tuple[str, ...] = ()
    policy: tuple[str, ...] = ()
    hosts: tuple[int, ...] = ()
    until: str = ""
    seed: int | None = None
    cut: bool = False
    check: bool = False


@dataclass(frozen=True, slots=True)
class SimulationRun:
    """One row of the comparison.

    Attributes:
        hosts: how many there were.
        seconds: of real time that it took; 0: nothing was simulated.
    """

    name: str
    hosts: int
    outcome: Outcome
    seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class SimulationReport:
    """The results of a command.

    Attributes:
        recording: None: a workload was simulated.
        replayed: the replay of the record with the recorded settings.
        agreement: of the recorded run with its simulation.
    """

    workload: Workload
    runs: tuple[SimulationRun, ...]
    recording: Recording | None = None
    replayed: Replay | None = None
    agreement: Agreement | None = None


def carry_out(request: SimulationRequest) -> SimulationReport:
    """Simulate; raises `ConfigError` or `RecordError` for errors in the files."""
    try:
        return _carried_out(request)
    except AssertionError as fault:
        if not request.check:
            raise
        raise RosrmError(
            f"{request.file}: an invariant of the core does not hold: {fault}"
        ) from None


def _carried_out(request: SimulationRequest) -> SimulationReport:
    registry = Registry.discover()
    changes = _changes(request)
    if _holds_record(request.file):
        return _of_record(request, changes, registry)
    if request.cut:
        raise ConfigError(f"--cut is for records, and {request.file} is a workload")
    comparison = load_workload(request.file, registry, changes, request.seed)
    workload = _ended(comparison.workload, _end(request))
    with _progress() as shown:
        runs = [
            run(workload, one, registry, shown, checks=request.check) for one in comparison.variants
        ]
    return SimulationReport(workload, tuple(runs))


def _changes(request: SimulationRequest) -> list[Node]:
    listed = read_variants(request.variants) if request.variants is not None else []
    return [
        *listed,
        *map(variant_in_text, request.variant),
        *(variant_of_option("--policy", ("scoring", "policy"), name) for name in request.policy),
        *(variant_of_option("--hosts", ("hosts",), count) for count in request.hosts),
    ]


def _holds_record(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            beginning = file.read(_LONGEST_OPENING)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {reason_of(error)}") from None
    if is_record(beginning):
        return True
    if b"\0" in beginning:
        raise ConfigError(f"{path}: is neither the record of a master's run nor a workload in YAML")
    return False


def _end(request: SimulationRequest) -> float:
    """Return the seconds after which each run ends; inf: when nothing can change any more."""
    if not request.until:
        return inf
    try:
        return Quantity("duration", above=True).parse(request.until)
    except ValueError as error:
        raise ConfigError(f"--until: {error}") from None


def _ended(workload: Workload, until: float) -> Workload:
    return replace(workload, until=min(until, workload.until))


# --- a record ---------------------------------------------------------------------------------


def _of_record(
    request: SimulationRequest, changes: Sequence[Node], registry: Registry
) -> SimulationReport:
    if request.seed is not None:
        raise ConfigError(f"--seed is for workloads: the record {request.file} leaves no chance")
    until = _end(request)
    recording = load_record(request.file, cut=request.cut)
    name = f"settings in {request.file}"
    base = settings_node(recording.header.config, name)
    variants = load_variants(base, changes, request.file, registry, title="simulated")
    watcher = checked if request.check else None
    replayed, workload = replay_record(recording, registry, until, watcher)
    hosts = len(replayed.outcome.curves.hosts)
    runs = [SimulationRun("recorded", hosts, replayed.outcome)]
    workload = _ended(workload, until)
    if not workload.hosts:
        raise RecordError(f"{request.file}: no host ever registered in it: nothing to simulate")
    with _progress() as shown:
        runs += [run(workload, one, registry, shown, checks=request.check) for one in variants]
    return SimulationReport(
        workload, tuple(runs), recording, replayed, compare(runs[0].outcome, runs[1].outcome)
    )


def load_record(path: Path, *, cut: bool = False) -> Recording:
    """Read a record; raises `RecordError` or `ConfigError`.

    Args:
        path: of its file.
        cut: accept an incomplete record.
    """
    try:
        with path.open("rb") as file:
            return read_record(file, str(path), cut=cut)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {reason_of(error)}") from None


def replay_record(
    recording: Recording,
    registry: Registry,
    until: float = inf,
    watcher: Watcher | None = None,
) -> tuple[Replay, Workload]:
    """Replay a record with its own settings, and make a workload of it.

    Args:
        recording: of a master's run; all of it is replayed, and goes into the workload.
        registry: of the plugins.
        until: seconds from the beginning, up to which the recorded run is measured.
        watcher: is called with each event and its commands.

    Raises:
        RecordError: its settings do not fit this version.
        ConfigError, PluginError: a plugin that it names is not installed.
    """
    try:
        config = ClusterConfig.from_json(json.dumps(dict(recording.header.config)))
    except ValueError as fault:
        raise RecordError(
            f"{recording.name}: its settings do not fit this rosrm (it was written by "
            f"{recording.header.software}): {fault}"
        ) from None
    extraction = Extraction(recording)

    def watch(state: MasterState, one: Happened, commands: Sequence[Command]) -> None:
        extraction.watch(state, one, commands)
        if watcher is not None:
            watcher(state, one, commands)

    placement, strategies, declared = _plugins(config, registry)
    replayed = replay(
        recording,
        config.core(),
        placement,
        strategies,
        watch,
        until,
        declared=declared,
        chain_of=partial(chain_of, registry),
    )
    return replayed, extraction.workload()


# --- runs -------------------------------------------------------------------------------------


def checked(state: MasterState, one: Happened, commands: Sequence[Command]) -> None:
    """Check the invariants of the core after an event that has commands."""
    if commands:
        try:
            check(state)
        except AssertionError as fault:
            raise AssertionError(f"after {type(one.event).__name__}: {fault}") from None


def run(
    workload: Workload, variant: Variant, registry: Registry, shown: Shown | None = None,
    *, checks: bool = False,
) -> SimulationRun:  # fmt: skip
    """Simulate one variant of a workload.

    `checks`: the invariants of the core are checked.
    """
    if variant.hosts is not None:
        workload = workload.with_hosts(variant.hosts)
    placement, strategies, declared = _plugins(variant.cluster, registry)
    simulation = Simulation(workload, variant.cluster.core(), placement, strategies, declared)
    simulation.checks = _CHECKED if checks else 0
    began = clocks.awake_time()
    outcome = simulation.run(None if shown is None else shown.named(variant.name))
    return SimulationRun(variant.name, len(workload.hosts), outcome, clocks.awake_time() - began)


def _plugins(
    config: ClusterConfig, registry: Registry
) -> tuple[PlacementPlugins, dict[str, MigrationStrategy], Declared]:
    chosen = config.migration.strategies
    return placement_of(config, registry), registry.migrations(chosen), registry.declared(chosen)


class Shown:
    """A progress display on a terminal, for runs that take more than a moment."""

    def __init__(self) -> None:
        from rich.console import Console  # noqa: PLC0415 - only the command line needs rich

        self._console = Console(stderr=True)
        self._status = self._console.status("")
        self._began = clocks.boot_time()
        self._on = False
        self._name = ""

    def named(self, name: str) -> Shown:
        """Set the variant of the next run; return the display."""
        self._name = name
        return self

    def __call__(self, progress: Progress) -> None:
        """Show the progress of a run."""
        if not sys.stderr.isatty() or clocks.boot_time() - self._began < _SHOWN_AFTER:
            return
        self._status.update(
            f"{self._name}: {progress.now:.0f} s simulated, {progress.ended} of "
            f"{progress.processes} processes have ended, {progress.events} events"
        )
        if not self._on:
            self._on = True
            self._status.start()

    def close(self) -> None:
        """Remove the display after the last run."""
        if self._on:
            self._status.stop()


@contextmanager
def _progress() -> Iterator[Shown]:
    shown = Shown()
    try:
        yield shown
    finally:
        shown.close()
