"""One instance of the supervisor: all that is known of it, and how it is said to people."""

from __future__ import annotations

import signal
from typing import Final

from rosrm.core.supervisor.rules import FenceRule, Key, RestartRule, StopRule

STARTING: Final = "starting"
RUNNING: Final = "running"
BACKOFF: Final = "backoff"
STOPPING: Final = "stopping"
EXITED: Final = "exited"
FAILED: Final = "failed"
REFUSED: Final = "refused"
FENCED: Final = "fenced"
WITHDRAWN: Final = "withdrawn"
ENDED: Final = frozenset({EXITED, FAILED, REFUSED, FENCED, WITHDRAWN})

#: What becomes of a stopping instance when nothing of it is left.
THEN_END: Final = "end"
THEN_RESTART: Final = "restart"
THEN_POLICY: Final = "policy"

STEPS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
_KILL: Final = len(STEPS) - 1
#: Seconds between one SIGKILL and the next, for members that were forked in between.
KILL_AGAIN: Final = 1.0
#: SIGKILLs after which a shutdown no longer waits (a process stuck in the kernel).
MOST_KILLS: Final = 5
#: The exit code of a run whose end nobody has seen.
UNKNOWN_EXIT: Final = -1


class Instance:
    """All that is known of one instance; JSON can hold every field.

    Attributes:
        then: what becomes of it when nothing of it is left; "" while nobody wants it stopped.
        pid: of its session leader; 0: none.
        started: when its last run began.
        recent: when the restarts within the policy's window were.
        deadline: of the next step (signal or restart); None: none is due.
        kills: how often SIGKILL was sent in this stop.
        step: the last step of the stop, an index of STEPS; -1: none.
        stop_began: when its stop began.
        trail: the steps of the stop, for people.
        fault: why its last run counts as failed, however it ended; "": by its exit alone.
        fence: None: none; what it is at its start, it stays.
        heard: when the master last heard this host, as far as is known, or when it was started.
        fenced: why it was fenced, for people; "": it was not, or was meant to end already.
        kill_by: when SIGKILL comes at the latest, once it is fenced; None: it is not.
        withdrawn: the shutdown of the supervisor stops it; no order of the client does.
    """

    __slots__ = (
        "cpu_time",
        "deadline",
        "exit_code",
        "exit_signal",
        "fault",
        "fence",
        "fenced",
        "heard",
        "key",
        "kill_by",
        "kills",
        "message",
        "peak_memory",
        "phase",
        "pid",
        "recent",
        "restart",
        "restarts",
        "run_time",
        "started",
        "step",
        "stop",
        "stop_began",
        "then",
        "trail",
        "withdrawn",
    )

    def __init__(self, key: Key, restart: RestartRule, stop: StopRule) -> None:
        self.key = key
        self.restart = restart
        self.stop = stop
        self.fence: FenceRule | None = None
        self.heard = 0.0
        self.fenced = ""
        self.kill_by: float | None = None
        self.withdrawn = False
        self.phase = STARTING
        self.then = ""
        self.pid = 0
        self.exit_code = 0
        self.exit_signal = 0
        self.restarts = 0
        self.recent: list[float] = []
        self.started = 0.0
        self.deadline: float | None = None
        self.step = -1
        self.kills = 0
        self.stop_began = 0.0
        self.trail = ""
        self.fault = ""
        self.peak_memory = 0.0
        self.cpu_time = 0.0
        self.run_time = 0.0
        self.message = ""

    @property
    def ended(self) -> bool:
        """Nothing of it runs, and nothing will."""
        return self.phase in ENDED

    @property
    def fence_at(self) -> float | None:
        """When it is fenced unless the master is known to hear this host; None: never (again)."""
        if self.fence is None or self.kill_by is not None or self.ended:
            return None
        return self.heard + self.fence.after


def end(instance: Instance, phase: str, message: str) -> None:
    """Nothing of it runs any more, and nothing will."""
    instance.phase = phase
    instance.then = ""
    instance.pid = 0
    instance.deadline = None
    instance.message = message


def stopping(instance: Instance) -> str:
    """Why and how far it is being stopped, for people."""
    why = {
        THEN_RESTART: "to restart it: ",
        THEN_POLICY: f"{ending(instance)}; {_left_to_stop(instance)}: ",
    }.get(instance.then, "")
    still = f"; still there after {instance.kills} times" if instance.kills > 1 else ""
    fenced = f"{instance.fenced}; " if instance.fenced else ""
    return f"{fenced}{why}{instance.trail}{still}"


def _left_to_stop(instance: Instance) -> str:
    return "stopping it" if instance.fault else "stopping what it left"


def ending(instance: Instance) -> str:
    """How its last run ended, for people."""
    if instance.fault:
        return instance.fault
    if instance.exit_signal:
        return f"killed by {signal_name(instance.exit_signal)}"
    if instance.exit_code == UNKNOWN_EXIT:
        return "ended while its host or its supervisor was down: its exit code is not known"
    return f"exit code {instance.exit_code}"


def signal_name(number: int) -> str:
    """SIGTERM for 15; a real-time signal by its number."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
