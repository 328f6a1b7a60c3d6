"""The workload of a simulation as a file: hosts, processes, the model, settings and variants."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from math import inf
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np

from rosrm.config.checking import near, validated
from rosrm.config.device_forms import AskedByKind, OfferedByKind, with_kinds
from rosrm.config.documents import Node, Problems, read
from rosrm.config.foreach import expanded
from rosrm.config.kinds import SIMULATION_KEYS, check_kind
from rosrm.config.merging import merged, written_out
from rosrm.config.options import PluginCheck
from rosrm.config.process import Labels, LabelsInFile, MigrationInFile
from rosrm.config.rules import check_amounts, check_name, refuse_namesakes
from rosrm.errors import ConfigError
from rosrm.extensions.registry import Registry
from rosrm.extensions.units import (
    Amount,
    ByteRate,
    Count,
    Fraction,
    PositiveByteRate,
    PositiveSeconds,
    Quantity,
    Seconds,
)
from rosrm.model.devices import DeviceNeed, device_fault, need_fault
from rosrm.model.values import Kind, MigrationPolicy, ProcessSpec, ResourceDescription
from rosrm.wording import counted
from rosrm_simulate.variants import Variant, check_keys, load_variants, text_of, variants_of
from rosrm_simulate.workload import (
    Curve,
    Model,
    ProcessPlan,
    SimulatedHost,
    SimulatedLink,
    Workload,
)

_MODEL: Final = Model()
_UNITS: Final = {"memory": "B", "cpu": "core", "disk": "B"}
_LIMITS: Final[Mapping[str, float]] = {"memory": 0.8, "cpu": 0.9, "disk": 0.9}


@dataclass(frozen=True)
class Drawn:
    """A quantity that is one value, or drawn evenly from `[lowest, highest]` by the seed."""

    quantity: Quantity

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return a schema with which pydantic calls `parse`."""
        from pydantic_core import core_schema  # noqa: PLC0415 - as in `Quantity`

        return core_schema.no_info_plain_validator_function(self.parse)

    def parse(self, given: object) -> tuple[float, float]:
        """Return lowest and highest value; raises `ValueError` with the allowed forms."""
        if not isinstance(given, (list, tuple)):
            value = self.quantity.parse(given)
            return value, value
        if len(given) != 2:
            raise ValueError(f"{list(given)!r} is not one value or [lowest, highest]")
        low, high = (self.quantity.parse(one) for one in given)
        if low > high:
            raise ValueError(f"in {list(given)!r} the lowest value is above the highest")
        return low, high


Span = tuple[float, float]
DrawnSize = Annotated[Span, Drawn(Quantity("size"))]
DrawnCores = Annotated[Span, Drawn(Quantity("cores"))]
DrawnSeconds = Annotated[Span, Drawn(Quantity("duration"))]
DrawnRate = Annotated[Span, Drawn(Quantity("amount"))]


@dataclass(frozen=True, slots=True)
class ModelInFile:
    """The model of every host."""

    period: Annotated[float, Quantity("duration", low=0.01, high=10.0)] = _MODEL.period
    usage_period: PositiveSeconds = _MODEL.usage_period
    start: Seconds = _MODEL.start
    ready: Seconds = _MODEL.ready
    stop: Seconds = _MODEL.stop
    wire: Seconds = _MODEL.wire
    handoff: Seconds = _MODEL.handoff


@dataclass(frozen=True, slots=True)
class LinkInFile:
    """Network interface of a host."""

    rate: PositiveByteRate
    round_trip: Seconds = 0.0
    limit: Fraction = 1.0

    def simulated(self) -> SimulatedLink:
        """Return the link of a simulated host."""
        return SimulatedLink(self.rate, self.round_trip, self.limit)


@dataclass(frozen=True, slots=True)
class HostInFile:
    """One host."""

    name: str
    memory: Annotated[float, Quantity("size", above=True)]
    cpu: Annotated[float, Quantity("cores", above=True)]
    disk: Annotated[float, Quantity("size")] = 0.0
    limits: Mapping[str, Fraction] = field(default_factory=dict)
    labels: Labels = field(default_factory=dict)
    max_processes: Count = 0
    busy: Mapping[str, Fraction] = field(default_factory=dict)
    joins: Seconds = 0.0
    leaves: Seconds | None = None
    lost: bool = False
    link: LinkInFile | None = None
    devices: OfferedByKind = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ProcessPlanInFile:
    """One process: its submission, and its real behaviour."""

    name: str
    arrives: DrawnSeconds = (0.0, 0.0)
    memory: DrawnSize = (0.0, 0.0)
    growth: DrawnRate = (0.0, 0.0)
    most: DrawnSize | None = None
    cpu: DrawnCores = (0.0, 0.0)
    disk: DrawnSize = (0.0, 0.0)
    duration: DrawnSeconds | None = None
    program: str = "simulated"
    needs: Mapping[str, Amount] = field(default_factory=dict)
    declares: tuple[Literal["memory", "cpu", "disk"], ...] = ()
    ros: bool = False
    namespace: str = ""
    priority: Annotated[int, Quantity(low=-(2**31), high=2**31 - 1, whole=True)] = 0
    labels: LabelsInFile = field(default_factory=LabelsInFile)
    devices: AskedByKind = field(default_factory=dict)
    migration: MigrationInFile = field(default_factory=MigrationInFile)
    talks_to: Mapping[str, ByteRate] = field(default_factory=dict)

    def devices_asked(self) -> tuple[DeviceNeed, ...]:
        """Return the devices that the process asks for."""
        return tuple(replace(need, kind=kind) for kind, need in self.devices.items())


@dataclass(frozen=True, slots=True)
class Comparison:
    """A workload with its variants: the given settings, then each change."""

    workload: Workload
    variants: tuple[Variant, ...]


def load_workload(
    path: str | Path, registry: Registry, changes: Sequence[Node] = (), seed: int | None = None
) -> Comparison:
    """Read the workload of a simulation; raises one `ConfigError` that lists all errors.

    Args:
        path: of the file.
        registry: the installed plugins.
        changes: variants beyond those of the file.
        seed: instead of the file's.
    """
    root, problems = read(path), Problems()
    check_kind(root, "simulation")
    check_keys(root, SIMULATION_KEYS, "", problems)
    hosts = [_host(node, problems) for node in _listed(root, "hosts", problems)]
    nodes = list(_listed(root, "processes", problems))
    known = [host for host in hosts if host is not None]
    random = np.random.default_rng(_seed(root, problems) if seed is None else seed)
    strategies = PluginCheck(registry, problems)
    plans = [_process(node, known, random, strategies, problems) for node in nodes]
    for what, listed in (("host", _listed(root, "hosts", Problems())), ("process", nodes)):
        refuse_namesakes(list(listed), what, problems)
    model = validated(ModelInFile, root.get("model") or Node({}, root.place), problems, "model")
    until = _until(root, problems)
    _refuse_endless(nodes, plans, until, problems)
    base = root.get("cluster") or Node({}, root.place)
    variants: tuple[Variant, ...] = ()
    wrong = []
    try:
        problems.raise_any()
    except ConfigError as error:
        wrong.append(str(error))
    try:
        variants = load_variants(base, [*variants_of(root), *changes], path, registry)
    except ConfigError as error:
        wrong.append(str(error))
    if wrong:
        raise ConfigError("\n".join(wrong))
    workload = Workload(
        text_of(root, "name") or Path(path).name, tuple(known),
        tuple(plan for plan in plans if plan is not None),
        Model(**_values(model)), until=until,
    )  # fmt: skip
    return Comparison(workload, variants)


def check_workload(path: Path, registry: Registry) -> str:
    """Return the summary that `rosrm config check` prints; raise `ConfigError`."""
    workload = load_workload(path, registry).workload
    processes = counted(len(workload.processes), "process", "processes")
    return f"a simulation: {counted(len(workload.hosts), 'host')}, {processes}"


def _values(model: Any) -> dict[str, Any]:
    return {f.name: getattr(model, f.name) for f in fields(model)}


# --- parts ------------------------------------------------------------------------------------


def _number(root: Node, key: str, quantity: Quantity, default: float, problems: Problems) -> float:
    node = root.get(key)
    if node is None:
        return default
    try:
        return quantity.parse(node.plain())
    except ValueError as error:
        problems.add(node.place, f"{key}: {error}")
        return default


def _seed(root: Node, problems: Problems) -> int:
    return int(_number(root, "seed", Quantity(high=2**63, whole=True), 0, problems))


def _until(root: Node, problems: Problems) -> float:
    return _number(root, "until", Quantity("duration", above=True), inf, problems)


def _listed(root: Node, section: str, problems: Problems) -> Iterator[Node]:
    """Yield the entries of a list, with each `foreach` expanded."""
    node = root.get(section)
    if node is None or not isinstance(node.value, tuple) or not node.value:
        what = "host" if section == "hosts" else "process"
        place = (node or root).place
        problems.add(place, f"{section}: a list of at least one {what} is required")
        return
    for entry in node.value:
        if not isinstance(entry.value, Mapping):
            problems.add(entry.place, f"{section}: each of the list is a mapping, with a `name`")
            continue
        yield from expanded(entry, problems)


def _host(node: Node, problems: Problems) -> SimulatedHost | None:
    check_name(node.get("name"), "host", problems)
    host = validated(HostInFile, node, problems)
    if host is None:
        return None
    for section in ("limits", "busy"):
        for resource, item in (node.get(section) or Node({}, node.place)).items.items():
            if resource not in _UNITS:
                place = item.key_place or item.place
                problems.add(place, f"{section}: unknown resource {resource!r}"
                             f"{near(resource, list(_UNITS))}")  # fmt: skip
    if host.leaves is not None and host.leaves <= host.joins:
        problems.add(
            node.deepest(("leaves",)).place,
            f"leaves ({host.leaves:g} s) must be after joins ({host.joins:g} s)",
        )
    resources = tuple(
        ResourceDescription(name, unit, getattr(host, name), "simulated", "attributed")
        for name, unit in _UNITS.items()
        if getattr(host, name) > 0.0
    )
    devices = tuple(one for units in with_kinds(host.devices).values() for one in units)
    fault = device_fault(devices)
    if fault:
        problems.add(node.deepest(("devices",)).place, f"devices: {fault}")
    return SimulatedHost(
        host.name, resources, {**_LIMITS, **host.limits}, host.labels, host.max_processes,
        host.busy, host.joins, inf if host.leaves is None else host.leaves, host.lost,
        host.link.simulated() if host.link is not None else None,
        devices,
    )  # fmt: skip


def _process(
    node: Node, hosts: Sequence[SimulatedHost], random: np.random.Generator, plugins: PluginCheck,
    problems: Problems,
) -> ProcessPlan | None:  # fmt: skip
    node = merged(Node({}, node.place), written_out(node))
    check_name(node.get("name"), "process", problems)
    check_amounts(node.get("needs"), "needs", problems)
    given = validated(ProcessPlanInFile, node, problems)
    if given is None:
        return None
    strategy = given.migration.strategy
    if strategy is not None:
        named = node.deepest(("migration", "strategy"))
        plugins.choice(
            "migration", strategy, named, node.get("migration", "options"), part="own_options"
        )
    fault = need_fault(given.devices_asked())
    if fault:
        problems.add(node.deepest(("devices",)).place, f"devices: {fault}")
    _check_fits(node, given, hosts, problems)

    def draw(span: Span) -> float:
        return float(random.uniform(*span)) if span[0] < span[1] else span[0]

    arrives, memory, growth = draw(given.arrives), draw(given.memory), draw(given.growth)
    most = inf if given.most is None else draw(given.most)
    uses = {"memory": memory, "cpu": draw(given.cpu), "disk": draw(given.disk)}
    declared: dict[str, float] = {name: uses[name] for name in given.declares}
    needs = {**declared, **given.needs}
    return ProcessPlan(
        _spec(given, needs), arrives, Curve.growing(memory, growth, most), uses["cpu"],
        uses["disk"], inf if given.duration is None else draw(given.duration),
    )  # fmt: skip


def _spec(given: ProcessPlanInFile, needs: Mapping[str, float]) -> ProcessSpec:
    migration = given.migration
    return ProcessSpec(
        given.name, given.namespace, command=(given.program,), ros=given.ros,
        kind=Kind.SERVICE if given.duration is None else Kind.JOB, needs=needs,
        required_labels=given.labels.required, preferred_labels=given.labels.preferred,
        avoided_labels=given.labels.avoided, priority=given.priority,
        migration=MigrationPolicy(migration.strategy, migration.overlap, migration.options),
        devices=given.devices_asked(),
        talks_to=given.talks_to,
    )  # fmt: skip


def _check_fits(
    node: Node, given: ProcessPlanInFile, hosts: Sequence[SimulatedHost], problems: Problems
) -> None:
    """Add a problem for a process that is larger than every host, and so could only wait."""
    amounts = {"memory": given.memory[1], "disk": given.disk[1]}
    declared = {name: amount for name, amount in given.needs.items() if name in _UNITS}
    for where, wanted in (((), amounts), (("needs",), declared)):
        for resource, amount in wanted.items():
            room = max((host.room(resource) for host in hosts), default=inf)
            if amount > room:
                place = node.deepest((*where, resource)).place
                problems.add(
                    place,
                    f"{given.name}: {resource} {amount:g} {_UNITS[resource]} is more than any host "
                    f"may give: {room:g} up to the limit of the largest",
                )


def _refuse_endless(
    nodes: Sequence[Node], plans: Sequence[ProcessPlan | None], until: float, problems: Problems
) -> None:
    """Add a problem for a run without an end."""
    for node, plan in zip(nodes, plans, strict=True):
        if plan is not None and plan.memory.most == inf == plan.duration == until:
            problems.add(
                node.deepest(("growth",)).place,
                f"{plan.name} grows without a bound; set `most` or `duration`, or the key `until`",
            )
