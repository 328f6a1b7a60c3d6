"""A resource manager for ROS 2: its Python client, and the names for plugins.

rosrm decides on which host each process of a ROS 2 application runs, starts the process there,
watches it, and moves it with its state. Programs and plugins import all names from `rosrm`::

    import rosrm

    with rosrm.Client() as client:                 # a running `rosrm master`
        client.submit({"name": "talker", "package": "demo_nodes_py", "executable": "talker"})
        client.wait("talker", timeout=30.0)
        for row in client.list_processes():
            print(row.name, row.state, row.host)

A plugin marks its hooks with `hookimpl` and returns offers::

    from rosrm import ScoringOffer, hookimpl

    @hookimpl
    def register_scoring_policies():
        return [ScoringOffer(name="fewest", create=Fewest, options=FewestOptions)]

The public names, by purpose:

Client          Client, load_work, RosSettings; its results: Listing, ProcessRow, HostRow,
                HostDescription, ResourceRow, DeviceRow, PluginRow, EventRow, LogChunk, WaitResult
Processes       ProcessSpec, Kind, RestartPolicy, Readiness, StopPolicy, MigrationPolicy,
                HostLossPolicy, IsolationPolicy, StandbyPolicy, Health, NeighbourRule, DeviceNeed,
                Artifact, ReschedulePolicy, StartOrder, GroupMembership, ArrayMembership, Schedule
Applications    Target, RolloutPolicy; results: ApplyResult, PlannedAction, Action, ApplicationRow,
                VersionRow, ModeRow
Plugins         hookimpl, NoOptions, SkipPlugin
  probes        ProbeOffer, Probe, ProcessMeasuring, DeviceFinding, HostLabelling, ProbeContext,
                Sessions, ResourceDescription, Accounting, Reading, Device
  scoring       ScoringOffer, ScoringPolicy, HostView, ProcessView, Scores, LinkView, FlowView,
                FloatArray, BoolArray
  filters       FilterOffer, PlacementFilter
  migration     MigrationOffer, MigrationStrategy, SpecChecking, HostChecking, Imaging,
                PeriodicImaging, Capabilities, options_of
  launchers     LauncherOffer, Launcher, LauncherContext, Launch, ProcessTreeLauncher,
                GraphDepartureLauncher, ImageLauncher
  plans         Move, Plan, Step, Start, AwaitReady, AwaitReleased, Stop, Configure, SetRestart,
                SetLifecycle, Commit, Execute, HandoffPhase, InstanceId
  checkpoints   CheckpointOffer, CheckpointPolicy, CheckpointView, CheckpointChoice, MemoryPacing,
                MemoryView
  event sinks   SinkOffer, EventSink, Notice, NoticesRefused
  options       Seconds, PositiveSeconds, Bytes, Fraction, Count, PositiveCount, Amount,
                ResourceName
Errors          RosrmError, ConfigError, PluginError, Refused, NoMaster
Version         __version__, PROTOCOL_VERSION

All units are seconds, bytes and fractions from 0 to 1. docs/reference/python.md has examples of the
client, docs/reference/plugins.md each hook and offer. Two packages have their own public names:
`rosrm.node` for authors of nodes that move with their state, and `rosrm.testing` for tests of
plugins. All other modules are private and may change.

A name is imported at its first use: `import rosrm` loads none of them.
"""

from typing import TYPE_CHECKING, Any, Final

from rosrm.version import PROTOCOL_VERSION, __version__

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.client.logs import LogChunk
    from rosrm.client.waiting import WaitResult
    from rosrm.config.work import load_work
    from rosrm.errors import (
        ConfigError,
        NoMaster,
        PluginError,
        Refused,
        RosrmError,
        SkipPlugin,
    )
    from rosrm.extensions.array_types import BoolArray, FloatArray
    from rosrm.extensions.contracts import (
        Capabilities,
        CheckpointChoice,
        CheckpointOffer,
        CheckpointPolicy,
        CheckpointView,
        DeviceFinding,
        FilterOffer,
        GraphDepartureLauncher,
        HostChecking,
        HostLabelling,
        HostView,
        ImageLauncher,
        Imaging,
        Launch,
        Launcher,
        LauncherContext,
        LauncherOffer,
        MemoryPacing,
        MemoryView,
        MigrationOffer,
        MigrationStrategy,
        NoOptions,
        PeriodicImaging,
        PlacementFilter,
        Probe,
        ProbeContext,
        ProbeOffer,
        ProcessMeasuring,
        ProcessTreeLauncher,
        ProcessView,
        Scores,
        ScoringOffer,
        ScoringPolicy,
        Sessions,
        SpecChecking,
    )
    from rosrm.extensions.hookspecs import hookimpl
    from rosrm.extensions.link_views import FlowView, LinkView
    from rosrm.extensions.options import options_of
    from rosrm.extensions.sinks import EventSink, NoticesRefused, SinkOffer
    from rosrm.extensions.units import (
        Amount,
        Bytes,
        Count,
        Fraction,
        PositiveCount,
        PositiveSeconds,
        ResourceName,
        Seconds,
    )
    from rosrm.model.applications import (
        Action,
        ApplicationRow,
        ApplyResult,
        PlannedAction,
        RolloutPolicy,
        Target,
        VersionRow,
    )
    from rosrm.model.arrays import ArrayMembership
    from rosrm.model.artifacts import Artifact
    from rosrm.model.devices import Device, DeviceNeed
    from rosrm.model.modes import ModeRow
    from rosrm.model.notices import Notice
    from rosrm.model.plan import (
        AwaitReady,
        AwaitReleased,
        Commit,
        Configure,
        Execute,
        HandoffPhase,
        Move,
        Plan,
        SetLifecycle,
        SetRestart,
        Start,
        Step,
        Stop,
    )
    from rosrm.model.ros_settings import RosSettings
    from rosrm.model.rows import (
        DeviceRow,
        EventRow,
        HostRow,
        Listing,
        PluginRow,
        ProcessRow,
        ResourceRow,
    )
    from rosrm.model.schedules import Schedule
    from rosrm.model.values import (
        Accounting,
        GroupMembership,
        Health,
        HostDescription,
        HostLossPolicy,
        InstanceId,
        IsolationPolicy,
        Kind,
        MigrationPolicy,
        NeighbourRule,
        ProcessSpec,
        Readiness,
        Reading,
        ReschedulePolicy,
        ResourceDescription,
        RestartPolicy,
        StandbyPolicy,
        StartOrder,
        StopPolicy,
    )

# Spelt out for tools that read this file without running it. A test compares the three lists.
__all__ = [
    "PROTOCOL_VERSION", "Accounting", "Action", "Amount", "ApplicationRow", "ApplyResult",
    "ArrayMembership", "Artifact", "AwaitReady", "AwaitReleased", "BoolArray", "Bytes",
    "Capabilities", "CheckpointChoice", "CheckpointOffer", "CheckpointPolicy", "CheckpointView",
    "Client", "Commit", "ConfigError", "Configure", "Count", "Device", "DeviceFinding",
    "DeviceNeed", "DeviceRow", "EventRow", "EventSink", "Execute", "FilterOffer", "FloatArray",
    "FlowView", "Fraction", "GraphDepartureLauncher", "GroupMembership", "HandoffPhase", "Health",
    "HostChecking", "HostDescription", "HostLabelling", "HostLossPolicy", "HostRow", "HostView",
    "ImageLauncher", "Imaging", "InstanceId", "IsolationPolicy", "Kind", "Launch", "Launcher",
    "LauncherContext", "LauncherOffer", "LinkView", "Listing", "LogChunk", "MemoryPacing",
    "MemoryView", "MigrationOffer", "MigrationPolicy", "MigrationStrategy", "ModeRow", "Move",
    "NeighbourRule", "NoMaster", "NoOptions", "Notice", "NoticesRefused", "PeriodicImaging",
    "PlacementFilter", "Plan", "PlannedAction", "PluginError", "PluginRow", "PositiveCount",
    "PositiveSeconds", "Probe", "ProbeContext", "ProbeOffer", "ProcessMeasuring", "ProcessRow",
    "ProcessSpec", "ProcessTreeLauncher", "ProcessView", "Readiness", "Reading", "Refused",
    "ReschedulePolicy", "ResourceDescription", "ResourceName", "ResourceRow", "RestartPolicy",
    "RolloutPolicy", "RosSettings", "RosrmError", "Schedule", "Scores", "ScoringOffer",
    "ScoringPolicy", "Seconds", "Sessions", "SetLifecycle", "SetRestart", "SinkOffer", "SkipPlugin",
    "SpecChecking", "StandbyPolicy", "Start", "StartOrder", "Step", "Stop", "StopPolicy", "Target",
    "VersionRow", "WaitResult", "__version__", "hookimpl", "load_work", "options_of",
]  # fmt: skip

#: The public names of each module below `rosrm`.
_NAMES: Final = {
    "client.client": "Client",
    "client.logs": "LogChunk",
    "client.waiting": "WaitResult",
    "config.work": "load_work",
    "errors": "ConfigError NoMaster PluginError Refused RosrmError SkipPlugin",
    "extensions.array_types": "BoolArray FloatArray",
    "extensions.contracts": (
        "Capabilities CheckpointChoice CheckpointOffer CheckpointPolicy CheckpointView "
        "DeviceFinding FilterOffer GraphDepartureLauncher HostChecking HostLabelling "
        "HostView ImageLauncher Imaging Launch Launcher LauncherContext LauncherOffer "
        "MemoryPacing MemoryView MigrationOffer MigrationStrategy NoOptions PeriodicImaging "
        "PlacementFilter Probe ProbeContext ProbeOffer ProcessMeasuring ProcessTreeLauncher "
        "ProcessView Scores ScoringOffer ScoringPolicy Sessions SpecChecking"
    ),
    "extensions.hookspecs": "hookimpl",
    "extensions.link_views": "FlowView LinkView",
    "extensions.options": "options_of",
    "extensions.sinks": "EventSink NoticesRefused SinkOffer",
    "extensions.units": (
        "Amount Bytes Count Fraction PositiveCount PositiveSeconds ResourceName Seconds"
    ),
    "model.applications": (
        "Action ApplicationRow ApplyResult PlannedAction RolloutPolicy Target VersionRow"
    ),
    "model.arrays": "ArrayMembership",
    "model.artifacts": "Artifact",
    "model.devices": "Device DeviceNeed",
    "model.modes": "ModeRow",
    "model.notices": "Notice",
    "model.plan": (
        "AwaitReady AwaitReleased Commit Configure Execute HandoffPhase Move Plan "
        "SetLifecycle SetRestart Start Step Stop"
    ),
    "model.ros_settings": "RosSettings",
    "model.rows": "DeviceRow EventRow HostRow Listing PluginRow ProcessRow ResourceRow",
    "model.schedules": "Schedule",
    "model.values": (
        "Accounting GroupMembership Health HostDescription HostLossPolicy InstanceId "
        "IsolationPolicy Kind MigrationPolicy NeighbourRule ProcessSpec Readiness Reading "
        "ReschedulePolicy ResourceDescription RestartPolicy StandbyPolicy StartOrder StopPolicy"
    ),
}
_MODULES: Final = {
    name: module for module, names in _NAMES.items() for name in names.split()
}  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a public name at its first use."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module  # noqa: PLC0415 - `import rosrm` has no use for it

    value = getattr(import_module(f"rosrm.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
