"""State of one instance of the supervisor, and its texts for listings."""

from __future__ import annotations

import signal
from typing import Final, Literal

from rosrm.core.supervisor.rules import FenceRule, Key, RestartRule, StopRule
from rosrm.wording import ending_of, size

Phase = Literal[
    "held", "starting", "running", "backoff", "stopping",
    "exited", "failed", "refused", "fenced", "withdrawn",
]  # fmt: skip
HELD: Final = "held"
STARTING: Final = "starting"
RUNNING: Final = "running"
BACKOFF: Final = "backoff"
STOPPING: Final = "stopping"
EXITED: Final = "exited"
FAILED: Final = "failed"
REFUSED: Final = "refused"
FENCED: Final = "fenced"
WITHDRAWN: Final = "withdrawn"
ENDED: Final[frozenset[Phase]] = frozenset({EXITED, FAILED, REFUSED, FENCED, WITHDRAWN})

#: Next action for a stopping instance once none of its processes is left; "": it is not stopping.
Then = Literal["", "end", "restart", "policy"]
THEN_END: Final = "end"
THEN_RESTART: Final = "restart"
THEN_POLICY: Final = "policy"

STEPS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
#: Seconds between two SIGKILLs, which also reach children that were forked in between.
KILL_AGAIN: Final = 1.0
#: Number of SIGKILLs after which a shutdown stops waiting for a process stuck in the kernel.
MOST_KILLS: Final = 5
#: Share of its limit that an instance uses when the kernel kills it for this limit.
_AT_LIMIT: Final = 0.9
#: Exit code of a run without an observed end.
UNKNOWN_EXIT: Final = -1


class Instance:
    """The state of one instance; every field is valid JSON.

    Attributes:
        then: next action once none of its processes is left; "": it is not being stopped.
        pid: pid of its session leader; 0: none.
        started: start of its last run.
        begun: start of its first run; None: it has not started.
        recent: times of the restarts within the policy's window.
        deadline: time of the next step (signal or restart); None: none is due.
        kills: number of SIGKILLs in this stop.
        step: last step of the stop, an index of STEPS; -1: none.
        stop_began: start of its stop.
        trail: text on the steps of the stop.
        fault: why its last run counts as failed, regardless of its exit; "": its exit decides.
        enforced: names of the limits and scheduling settings that hold in its last run.
        fence: None: no fence; never changes after the start.
        heard: last contact: newest known time at which the master received a message of this host,
            or the time of the start.
        fenced: text on why it was fenced; "": not fenced, or already being stopped for good.
        kill_by: latest time of SIGKILL after it was fenced; None: not fenced.
        withdrawn: the shutdown of the supervisor stops it, not an order of the client; or the
            master decides on its restart, because the machine was restarted.
        slots: it starts once fewer than this number of others are active; 0: it is never held.
        adopted: its last run was started without rosrm, so its exit code is never known.
        unfound: sentence on files of its command that did not exist at its last start; "":
            none.
    """

    __slots__ = (
        "adopted", "begun", "cpu_time", "deadline", "enforced", "exit_code", "exit_signal", "fault",
        "fence", "fenced", "heard", "key", "kill_by", "kills", "message", "peak_memory",
        "phase", "pid", "recent", "restart", "restarts", "run_time", "slots", "started",
        "step", "stop", "stop_began", "then", "trail", "unfound", "withdrawn",
    )  # fmt: skip

    def __init__(self, key: Key, restart: RestartRule, stop: StopRule) -> None:
        self.key = key
        self.restart = restart
        self.stop = stop
        self.fence: FenceRule | None = None
        self.heard = 0.0
        self.fenced = ""
        self.kill_by: float | None = None
        self.withdrawn = False
        self.adopted = False
        self.unfound = ""
        self.slots = 0
        self.phase: Phase = STARTING
        self.then: Then = ""
        self.pid = 0
        self.exit_code = 0
        self.exit_signal = 0
        self.restarts = 0
        self.recent: list[float] = []
        self.started = 0.0
        self.begun: float | None = None
        self.deadline: float | None = None
        self.step = -1
        self.kills = 0
        self.stop_began = 0.0
        self.trail = ""
        self.fault = ""
        self.enforced: tuple[str, ...] = ()
        self.peak_memory = 0.0
        self.cpu_time = 0.0
        self.run_time = 0.0
        self.message = ""

    @property
    def ended(self) -> bool:
        """Return True if no process of the instance runs, and none will."""
        return self.phase in ENDED

    def time_run(self, now: float) -> float:
        """Return the seconds since the start of its first run; without a process, of its last run.

        A restart does not begin a new time limit, so the whole time counts while it runs.
        """
        if not self.pid or self.begun is None:
            return self.run_time
        return max(0.0, now - self.begun)

    @property
    def fence_at(self) -> float | None:
        """Return the time of its fence without further contact; None: no fence, or fenced."""
        if self.fence is None or self.kill_by is not None or self.ended:
            return None
        return self.heard + self.fence.after


def end(instance: Instance, phase: Phase, message: str) -> None:
    """Set an instance to ended."""
    instance.phase = phase
    instance.then = ""
    instance.pid = 0
    instance.deadline = None
    instance.message = message


def stopping(instance: Instance) -> str:
    """Return a text on the cause and the progress of a stop."""
    why = {
        THEN_RESTART: "to restart it: ",
        THEN_POLICY: f"{ending(instance)}; {_left_to_stop(instance)}: ",
    }.get(instance.then, "")
    still = f"; still there after {instance.kills} times" if instance.kills > 1 else ""
    fenced = f"{instance.fenced}; " if instance.fenced else ""
    return f"{fenced}{why}{instance.trail}{still}"


def _left_to_stop(instance: Instance) -> str:
    return "stopping it" if instance.fault else "stopping its remaining children"


def ending(instance: Instance) -> str:
    """Return a text on the end of its last run."""
    if instance.fault:
        return instance.fault
    if instance.exit_signal:
        return ending_of(-instance.exit_signal)
    if instance.exit_code == UNKNOWN_EXIT and instance.adopted:
        return "ended; its exit code is not known, because rosrm did not start this run"
    if instance.exit_code == UNKNOWN_EXIT:
        return "ended while its host or its supervisor was down: its exit code is not known"
    hint = f"; {instance.unfound}" if instance.exit_code and instance.unfound else ""
    return ending_of(instance.exit_code) + hint


def killed_for_memory(used: float, limit: float) -> str:
    """Return a text on an end by the OOM killer; `limit` 0: the instance has none."""
    if limit and used >= _AT_LIMIT * limit:
        return f"killed: used {size(used)} of {size(limit)}"
    of_limit = f" of {size(limit)}" if limit else ""
    return f"killed: its host ran out of memory; it used {size(used)}{of_limit}"
