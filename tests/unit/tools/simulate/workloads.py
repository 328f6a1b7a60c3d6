"""Small workloads, with functions that run and record them."""

from __future__ import annotations

from io import BytesIO
from math import inf

from rosrm.config.settings import ClusterConfig
from rosrm.core.master.settings import CoreSettings
from rosrm.extensions.placement import PlacementPlugins, ScoringLink
from rosrm.model.codec import to_plain
from rosrm.model.values import Kind, MigrationPolicy, ProcessSpec, ResourceDescription
from rosrm.recording.encoding import decisions, encode, encode_decisions
from rosrm.recording.frames import FrameKind, frame, opening
from rosrm.recording.reader import Header, read_record
from rosrm_migration.handoff import Handoff, HandoffOptions
from rosrm_migration.relaunch import Relaunch, RelaunchOptions
from rosrm_scoring.weighted import Weighted, WeightedOptions
from rosrm_simulate.engine import Simulation
from rosrm_simulate.workload import Curve, ProcessPlan, SimulatedHost, Workload
from tests.unit.core.cluster import declared_by

MIB = 2.0**20
EQ1 = PlacementPlugins((ScoringLink("weighted", Weighted(WeightedOptions())),))
STRATEGIES = {"relaunch": Relaunch(RelaunchOptions()), "handoff": Handoff(HandoffOptions())}


def host(name: str, memory: float = 1024.0, cpu: float = 4.0, **fields) -> SimulatedHost:
    """Return a host with `memory` MiB."""
    fields.setdefault("limits", {"memory": 0.8})
    resources = (
        ResourceDescription("memory", "B", memory * MIB),
        ResourceDescription("cpu", "core", cpu),
    )
    return SimulatedHost(name, resources, **fields)


def plan(
    name: str, memory: float = 50.0, *, at: float = 0.0, cpu: float = 0.0, duration: float = inf,
    growth: float = 0.0, most: float = inf, strategy: str | None = None, **spec,
) -> ProcessPlan:  # fmt: skip
    """Return a process that uses and declares `memory` MiB."""
    kind = Kind.SERVICE if duration == inf else Kind.JOB
    spec.setdefault("needs", {"memory": memory * MIB, "cpu": cpu})
    made = ProcessSpec(
        name, command=("run",), kind=kind, migration=MigrationPolicy(strategy), **spec
    )
    curve = Curve.growing(memory * MIB, growth * MIB, most * MIB)
    return ProcessPlan(made, at, curve, cpu, duration=duration)


def simulation(hosts, plans, *, until: float = inf, requests=(), **settings) -> Simulation:
    workload = Workload("test", tuple(hosts), tuple(plans), requests=tuple(requests), until=until)
    return Simulation(workload, CoreSettings(**settings), EQ1, STRATEGIES, declared_by(STRATEGIES))


def run(hosts, plans, **more):
    """Return the outcome of a workload."""
    return simulation(hosts, plans, **more).run()


def recorded(simulated: Simulation, config: ClusterConfig | None = None) -> bytes:
    """Return the record that the simulated master would have written."""
    header = Header("1", "test", to_plain(config or ClusterConfig()), 1, 0.0, {})
    written = [opening(), frame(FrameKind.HEADER, header.encoded())]
    take = simulated.meter.take

    def note(state, event, commands, now):
        written.append(frame(*encode(event, now, state.wall)))
        decided = decisions(commands)
        if decided:
            written.append(frame(FrameKind.DECISIONS, encode_decisions(decided)))
        take(state, event, commands, now)

    simulated.meter.take = note
    simulated.run()
    return b"".join([*written, frame(FrameKind.END, b"stopped")])


def read(content: bytes, **options):
    return read_record(BytesIO(content), "r.rosrec", **options)
