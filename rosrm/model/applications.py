"""Values of applications: named sets of processes with versions, as desired states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Literal

from rosrm.model.values import EMPTY, ProcessSpec

#: What happens when a replaced process fails: the former version is applied again ("return"), or
#: the processes that are not replaced yet stay as they are ("pause").
OnFailure = Literal["return", "pause"]


@dataclass(frozen=True, slots=True)
class RolloutPolicy:
    """Way in which changed processes are replaced.

    Attributes:
        max_parallel: highest number of running processes that are replaced at the same time, from
            1.
        healthy_for: seconds for which a new instance must run without a restart.
        on_failure: treatment of a replacement that fails: "return" to the former version, or
            "pause" with the processes that are not replaced yet as they are.
    """

    max_parallel: int = 1
    healthy_for: float = 10.0
    on_failure: OnFailure = "return"


@dataclass(frozen=True, slots=True)
class Target:
    """Desired state of one application in a request.

    Attributes:
        application: its name.
        specs: all its processes, whose `application` is this name; (): none are given.
        version: number of an earlier version; 0: that of `specs` or, without any, no version: the
            application is cancelled.
        rollout: way in which changed processes are replaced.
    """

    application: str
    specs: tuple[ProcessSpec, ...] = ()
    version: int = 0
    rollout: RolloutPolicy = RolloutPolicy()


class Action(str, Enum):
    """Action on a process by which it gets as its application wants it.

    `CHANGE` applies to the running instance, `REPLACE` starts a new instance with the new spec, and
    `MOVE` runs the same spec on another host.
    """

    START = "start"
    STOP = "stop"
    CHANGE = "change"
    REPLACE = "replace"
    MOVE = "move"


@dataclass(frozen=True, slots=True)
class PlannedAction:
    """One action of a plan.

    Attributes:
        process: name of the process.
        action: action on the process.
        application: name of its application; "": it belongs to none.
        host: name of the host on which it will run; "": it waits, or is stopped.
        before: name of the host on which it runs now; "": it does not run.
        reason: cause of the action.
        fields: names of the changed fields of the spec.
        waits: why it will wait after the action; "": it will not.
        decision: placement decision, as in the event record; None: nothing is placed.
        version: number of the requested version; 0: a cancellation, or a plan, which makes none.
    """

    process: str
    action: Action
    application: str = ""
    host: str = ""
    before: str = ""
    reason: str = ""
    fields: tuple[str, ...] = ()
    waits: str = ""
    decision: Mapping[str, Any] | None = None
    version: int = 0


@dataclass(frozen=True, slots=True)
class ApplyResult:
    """Answer to a request on applications.

    Attributes:
        message: the master's message.
        actions: actions that follow, or would follow; (): everything is as desired.
        work: digest of the requested work, which tells a plan from that of other work; "": unknown,
            as in the answer to a switch of modes that is not a plan.
        mode: name of the mode of a plan; "": it is one of applications.
    """

    message: str
    actions: tuple[PlannedAction, ...] = ()
    work: str = ""
    mode: str = ""

    @property
    def versions(self) -> Mapping[str, int]:
        """Return the number of the requested version of each application with an action."""
        return {one.application: one.version for one in self.actions}


#: Condition of an application.
ApplicationState = Literal["applying", "returning", "running", "degraded", "paused", "cancelled"]


@dataclass(frozen=True, slots=True)
class VersionRow:
    """One version of an application.

    Attributes:
        number: of the version; the first is 1.
        wall_time: unix time of its request.
        by: principal that requested it; "": unknown.
        processes: number of its processes.
        note: origin of the version, if it is not a file.
        given_up: why the master returned to another version; "": it did not.
        wanted: it is the desired state.
    """

    number: int
    wall_time: float
    by: str
    processes: int
    note: str = ""
    given_up: str = ""
    wanted: bool = False


@dataclass(frozen=True, slots=True)
class ApplicationRow:
    """One application.

    Attributes:
        name: of the application.
        owner: principal that applied it first; "": unknown.
        state: "applying": processes are being started, stopped or replaced; "returning": the former
            version is being applied again; "running": all is as desired; "degraded": a process has
            failed or does not run; "paused": a replacement has failed; "cancelled": no version is
            desired.
        version: number of the desired version; 0: it is cancelled.
        pending: name of each process that is not yet as desired, to the reason; also of one whose
            host has not reported since the master started.
        running: number of its processes that run, or have finished.
        processes: number of its processes.
        reason: why it is not as desired; "": it is.
        versions: kept versions, the oldest first.
    """

    name: str
    owner: str
    state: ApplicationState
    version: int
    processes: int
    running: int
    pending: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    reason: str = ""
    versions: tuple[VersionRow, ...] = ()

    @property
    def returned_from(self) -> VersionRow | None:
        """Return the newest version if the master returned from it; None: it did not."""
        newest = self.versions[-1] if self.versions else None
        is_given_up = newest is not None and newest.given_up and newest.number > self.version > 0
        return newest if is_given_up else None
