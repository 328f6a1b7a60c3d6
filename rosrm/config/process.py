"""Process entry of a work file: the forms of its values."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, ClassVar, Final, Literal, TypeVar

from rosrm.config.device_forms import AskedByKind
from rosrm.config.markers import NullIsEmpty, PlainWord, Words
from rosrm.config.parameter_forms import ParametersInFile
from rosrm.config.settings import DEFAULT_ENGINE
from rosrm.config.start_order_forms import StartOrderInFile
from rosrm.extensions.units import (
    Amount,
    ByteRate,
    Count,
    PositiveCount,
    PositiveSeconds,
    Quantity,
    Seconds,
)
from rosrm.model.adoption import NO_ADOPTION
from rosrm.model.arrays import ArrayMembership
from rosrm.model.artifacts import artifacts_of
from rosrm.model.durations import LONGEST
from rosrm.model.limits import LARGEST_CPU_NUMBER
from rosrm.model.parameters import flattened
from rosrm.model.schedules import SHORTEST, Schedule
from rosrm.model.values import (
    EMPTY,
    Autostart,
    Component,
    Container,
    Enforcement,
    GroupMembership,
    Health,
    HostLossAction,
    HostLossPolicy,
    IsolationAction,
    IsolationPolicy,
    Kind,
    LifecyclePolicy,
    Limits,
    MigrationPolicy,
    NeighbourRule,
    ParameterSource,
    ProcessSpec,
    Readiness,
    ReadinessKind,
    Realtime,
    ReschedulePolicy,
    RestartCondition,
    RestartPolicy,
    StandbyPolicy,
    StartOrder,
    StopPolicy,
)

_RESTART: Final = RestartPolicy()
_READINESS: Final = Readiness()
_LIFECYCLE: Final = LifecyclePolicy()
_STOP: Final = StopPolicy()

Text = Annotated[str, PlainWord()]
Name = Annotated[str, PlainWord(boolean=False)]
Labels = Annotated[Mapping[str, Text], NullIsEmpty()]
_Value = TypeVar("_Value")
ListOfWords = Annotated[tuple[Text, ...], Words()]
_CommandLine = Annotated[tuple[Text, ...], Words("program")]
_Arguments = Annotated[tuple[Text, ...], Words("argument")]
_CpuNumber = Annotated[int, Quantity(high=LARGEST_CPU_NUMBER, whole=True)]


@dataclass(frozen=True, slots=True)
class RestartInFile:
    """Policy for restarts of an ended process on its host; `kind` determines the default `when`."""

    when: RestartCondition | None = None
    delay: Seconds = _RESTART.delay
    max_delay: Seconds = _RESTART.max_delay
    factor: Annotated[float, Quantity(low=1.0, high=100.0)] = _RESTART.factor
    attempts: Count = _RESTART.attempts
    window: PositiveSeconds = _RESTART.window


@dataclass(frozen=True, slots=True)
class RescheduleInFile:
    """Starts on other hosts after the restart policy has given up."""

    attempts: Count = 0
    delay: Seconds = 0.0


@dataclass(frozen=True, slots=True)
class MigrationInFile:
    """Migration of a process to another host; no strategy: the process stays."""

    strategy: str | None = None
    overlap: bool = True
    options: Annotated[Mapping[str, Any], NullIsEmpty()] = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class ReadinessInFile:
    """Condition for an instance to count as ready."""

    kind: ReadinessKind = "auto"
    timeout: PositiveSeconds = _READINESS.timeout


@dataclass(frozen=True, slots=True)
class StopInFile:
    """Seconds between SIGINT, SIGTERM and SIGKILL."""

    interrupt_grace: Seconds = _STOP.interrupt_grace
    terminate_grace: Seconds = _STOP.terminate_grace


@dataclass(frozen=True, slots=True)
class HostLossInFile:
    """Reaction of the master when the host of a process is lost."""

    then: HostLossAction = "wait"
    delay: Seconds = 0.0


@dataclass(frozen=True, slots=True)
class IsolationInFile:
    """Reaction of a host that cannot reach the master; 0 s: before a successor starts elsewhere."""

    then: IsolationAction = "keep"
    after: Seconds = 0.0


@dataclass(frozen=True, slots=True)
class StandbyInFile:
    """Second instance on another host that follows the state."""

    wanted: bool = True
    apart_by: tuple[Name, ...] = ()


@dataclass(frozen=True, slots=True)
class HealthInFile:
    """Conditions for an instance to count as healthy."""

    topic: str = ""
    rate: Annotated[float, Quantity(low=0.0, high=10_000.0, hint="Hz")] = 0.0
    lifecycle: str = ""
    timeout: PositiveSeconds = 5.0


@dataclass(frozen=True, slots=True)
class LifecycleInFile:
    """State to which a host brings a lifecycle node."""

    autostart: Autostart = "active"
    timeout: PositiveSeconds = _LIFECYCLE.timeout


@dataclass(frozen=True, slots=True)
class LabelsInFile:
    """Host labels that a process requires, prefers or avoids."""

    required: Labels = field(default_factory=lambda: EMPTY)
    preferred: Labels = field(default_factory=lambda: EMPTY)
    avoided: Labels = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class NeighboursInFile:
    """Processes near which a process runs, or apart from which."""

    processes: tuple[Name, ...]
    by: Name = ""
    prefer: bool = False


@dataclass(frozen=True, slots=True)
class SpreadInFile:
    """Group whose processes run apart from each other; the default is the process itself."""

    by: Name = ""
    group: Name = ""
    prefer: bool = False


@dataclass(frozen=True, slots=True)
class LimitsInFile:
    """Limits that the host of a process enforces."""

    memory: Annotated[float, Quantity("size")] = 0.0
    memory_high: Annotated[float, Quantity("size")] = 0.0
    cpu: Annotated[float, Quantity("cores")] = 0.0
    enforce: Enforcement = "preferred"


@dataclass(frozen=True, slots=True)
class RealtimeInFile:
    """Real-time scheduling of a process."""

    policy: Literal["fifo", "rr"]
    priority: Annotated[int, Quantity(low=1, high=99, whole=True)]


@dataclass(frozen=True, slots=True)
class SecretInFile:
    """Source of a secret on the host that runs the process."""

    file: str


@dataclass(frozen=True, slots=True)
class ContainerInFile:
    """Container in which a process runs."""

    image: Name
    engine: Name = DEFAULT_ENGINE


@dataclass(frozen=True, slots=True)
class ProcessInFile:
    """One process, with the keys of ROS 2 launch; shorthands are in long form.

    Attributes:
        SECTIONS: keys of the file beside this entry.
        EXAMPLES: valid values of each key that is no plain text, number or boolean, for messages.
        array: name and index, after the expansion of the array.
    """

    SECTIONS: ClassVar[tuple[str, ...]] = ("app", "rollout", "processes", "defaults", "group")
    EXAMPLES: ClassVar[Mapping[str, Sequence[str]]] = {
        "arguments": ("[--rate, 10]",),
        "parameters": ("{width: 320}",),
        "remappings": ("{image: front/image}",),
        "environment": ("{RATE: 10}",),
        "restart": ("always", "{when: on-failure, attempts: 3}"),
        "needs": ("{memory: 200MB, cpu: 0.5}",),
        "labels": ("{required: {camera: front}}",),
        "migration": ("{strategy: NAME}",),
        "readiness": ("running", "{timeout: 10s}"),
        "stop": ("{interrupt_grace: 5s}",),
        "host_loss": ("elsewhere", "{then: elsewhere, delay: 10s}"),
        "isolation": ("stop", "{then: stop, after: 10s}"),
        "standby": ("true", "{apart_by: [rack]}"),
        "health": ("{topic: scan, rate: 10}", "{lifecycle: active}"),
        "lifecycle": ("active", "{autostart: inactive, timeout: 10s}"),
        "components": ("[{plugin: my_robot::Detector, name: detector, package: my_robot}]",),
        "near": ("camera", "{processes: [camera], by: rack}"),
        "apart": ("camera", "{processes: [camera], by: rack}"),
        "spread": ("rack", "{}"),
        "talks_to": ("{camera: 30MB/s}",),
        "reschedule": ("{attempts: 2}",),
        "limits": ("{memory: 500MB, cpu: 1.5}",),
        "cpus": ("[2, 3]",),
        "realtime": ("{policy: fifo, priority: 50}",),
        "devices": ("{gpu: 1, camera: front}",),
        "at": ('"06:00"',),
        "on": ("[mon, fri]",),
        "after": ("camera", "{camera: finished}"),
        "together": ("swarm",),
        "secrets": ("{TOKEN: {file: /etc/token}}",),
        "container": ("ubuntu:24.04",),
        "artifacts": ("{model.onnx: ./model.onnx}",),
    }

    name: str
    node_name: str = ""
    namespace: str = ""
    package: str | None = None
    executable: str | None = None
    module: str | None = None
    command: _CommandLine = ()
    prefix: _CommandLine = ()
    arguments: _Arguments = ()
    parameters: Annotated[Mapping[str, Any] | tuple[ParameterSource, ...], ParametersInFile()] = (
        field(default_factory=lambda: EMPTY)
    )
    remappings: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    environment: Mapping[str, Text] = field(default_factory=lambda: EMPTY)
    working_directory: str | None = None
    ros: bool | None = None
    kind: Literal["service", "job"] = "service"
    restart: RestartInFile = field(default_factory=RestartInFile)
    needs: Mapping[str, Amount] = field(default_factory=lambda: EMPTY)
    labels: LabelsInFile = field(default_factory=LabelsInFile)
    priority: Annotated[int, Quantity(low=-(2**31), high=2**31 - 1, whole=True)] = 0
    migration: MigrationInFile = field(default_factory=MigrationInFile)
    readiness: ReadinessInFile = field(default_factory=ReadinessInFile)
    stop: StopInFile = field(default_factory=StopInFile)
    host_loss: HostLossInFile = field(default_factory=HostLossInFile)
    isolation: IsolationInFile = field(default_factory=IsolationInFile)
    standby: StandbyInFile = field(default_factory=lambda: StandbyInFile(wanted=False))
    health: HealthInFile | None = None
    lifecycle: LifecycleInFile | None = None
    components: tuple[Component, ...] = ()
    near: tuple[NeighboursInFile, ...] = ()
    apart: tuple[NeighboursInFile, ...] = ()
    spread: SpreadInFile | None = None
    talks_to: Annotated[Mapping[str, ByteRate], NullIsEmpty()] = field(
        default_factory=lambda: EMPTY
    )
    reschedule: RescheduleInFile = field(default_factory=RescheduleInFile)
    protect: bool = False
    time_limit: Seconds = 0.0
    limits: LimitsInFile = field(default_factory=LimitsInFile)
    cpus: tuple[_CpuNumber, ...] = ()
    realtime: RealtimeInFile | None = None
    nice: Annotated[int, Quantity(low=-20, high=19, whole=True)] = 0
    devices: AskedByKind = field(default_factory=lambda: EMPTY)
    array: tuple[str, int] | None = None
    parallel: PositiveCount | None = None
    retries: Count | None = None
    every: Annotated[float, Quantity("duration", low=SHORTEST, hint="seconds")] = 0.0
    at: tuple[str, ...] = ()
    on: tuple[str, ...] = ()
    after: Annotated[StartOrder, StartOrderInFile()] = field(default_factory=StartOrder)
    together: Name = ""
    secrets: Annotated[Mapping[str, SecretInFile], NullIsEmpty()] = field(
        default_factory=lambda: EMPTY
    )
    container: ContainerInFile | None = None
    artifacts: Annotated[Mapping[str, Text], NullIsEmpty()] = field(default_factory=lambda: EMPTY)

    def spec(self) -> ProcessSpec:
        """Return the process as the spec that the core uses.

        By default a service restarts on failure, for example after a power failure. A job does not
        restart, because it may not be repeatable.
        """
        sources = self.parameters if isinstance(self.parameters, tuple) else ()
        plain = self.parameters if isinstance(self.parameters, Mapping) else {}
        return _same(
            ProcessSpec,
            self,
            parameters=dict(flattened(plain)),
            parameter_sources=sources,
            kind=Kind(self.kind),
            restart=self._restart_policy(),
            required_labels=self.labels.required,
            preferred_labels=self.labels.preferred,
            avoided_labels=self.labels.avoided,
            migration=_same(MigrationPolicy, self.migration),
            readiness=_same(Readiness, self.readiness),
            stop=_same(StopPolicy, self.stop),
            host_loss=_same(HostLossPolicy, self.host_loss),
            isolation=_same(IsolationPolicy, self.isolation),
            standby=_same(StandbyPolicy, self.standby),
            health=Health() if self.health is None else _same(Health, self.health),
            lifecycle=_LIFECYCLE
            if self.lifecycle is None
            else _same(LifecyclePolicy, self.lifecycle),
            components=tuple(
                replace(one, parameters=dict(flattened(one.parameters))) for one in self.components
            ),
            neighbours=tuple(self._neighbour_rules()),
            reschedule=_same(ReschedulePolicy, self.reschedule),
            limits=_same(Limits, self.limits),
            realtime=Realtime() if self.realtime is None else _same(Realtime, self.realtime),
            devices=tuple(replace(need, kind=kind) for kind, need in self.devices.items()),
            array=self._membership(),
            schedule=_same(Schedule, self),
            start_order=self.after,
            group=GroupMembership(),  # of the file as a whole, as the application
            application="",
            secrets={name: secret.file for name, secret in self.secrets.items()},
            container=Container() if self.container is None else _same(Container, self.container),
            adoption=NO_ADOPTION,  # of a process that runs, so no file has one
            artifacts=artifacts_of(self.artifacts),
            given=(),
        )

    def _restart_policy(self) -> RestartPolicy:
        when = self.restart.when or ("never" if self.kind == "job" else "on-failure")
        policy = _same(RestartPolicy, self.restart, when=when)
        if self.retries is None:
            return policy
        # Each restart counts for the whole run, however long the job runs before it fails.
        return replace(policy, when="on-failure", attempts=self.retries, window=LONGEST)

    def _membership(self) -> ArrayMembership:
        name, index = self.array or ("", 0)
        return ArrayMembership(name, index, self.parallel or 0)

    def _neighbour_rules(self) -> Iterator[NeighbourRule]:
        for one in self.near:
            yield NeighbourRule("near", one.processes, by=one.by, prefer=one.prefer)
        for one in self.apart:
            yield NeighbourRule("apart", one.processes, by=one.by, prefer=one.prefer)
        spread = self.spread
        if spread is not None:
            group = spread.group or self.name
            yield NeighbourRule("apart", group=group, by=spread.by, prefer=spread.prefer)


def _same(wanted: type[_Value], of: Any, **others: Any) -> _Value:
    """Return a value of the core with the fields of its counterpart in the file, and `others`."""
    names = [f.name for f in fields(wanted) if f.name not in others]  # type: ignore[arg-type]
    return wanted(**{name: getattr(of, name) for name in names}, **others)
