"""Shutdown of a slave: inform the master, then stop the processes or leave them running."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

from rosrm import clocks
from rosrm.config.settings import HostConfig
from rosrm.core.slave import commands
from rosrm.core.slave.state import SlaveState
from rosrm.errors import describe_fault
from rosrm.model.durations import LONGEST_STOP
from rosrm.model.values import InstanceState, InstanceStatus, StopPolicy
from rosrm.ros.slave.endpoint import SlaveEndpoint
from rosrm.slave.launch.starter import Starter
from rosrm.slave.supervisor_client import SupervisorLink
from rosrm.wording import counted, listed

_log = logging.getLogger("rosrm.slave")

#: Option of `rosrm slave`, and the name of this cause of a shutdown.
STOP_ALL: Final = "--stop-all"
#: Seconds for the master to acknowledge the end of this slave.
_LEAVE_PATIENCE: Final = 2.0
#: Seconds for what is killed after the longest stop to end.
_KILL_PATIENCE: Final = 10.0


@dataclass
class Shutdown:
    """Shutdown of one slave, also without its master or its supervisor.

    Attributes:
        state: instances of the slave; read-only here.
        serve: runs the loop of the slave while its argument returns True.
        has_begun: the slave accepts no more work.
        keeps: the slave starts no more processes, because it has reported the running ones to the
            master.
        supervisor_left: the supervisor has ended or failed.
    """

    config: HostConfig
    state: SlaveState
    starter: Starter
    supervisor: SupervisorLink
    endpoint: SlaveEndpoint
    serve: Callable[[Callable[[], bool]], None]
    has_begun: bool = False
    keeps: bool = False
    supervisor_left: bool = False
    _supervisor_fault: str = field(init=False, default="")
    _is_informed: bool = field(init=False, default=False)
    _kill_at: float = field(init=False, default=0.0)  # awake time; 0.0: no stop began

    def note_supervisor_left(self, fault: str) -> None:
        """Note the end of the supervisor; without a fault it has stopped everything."""
        self.supervisor_left, self._supervisor_fault = True, fault
        self.endpoint.failure = self.endpoint.failure or fault

    def carry_out(self, cause: str) -> int:
        """Inform the master, then stop the processes or leave them running; return the exit code.

        The cause is a signal or `--stop-all`; "": the endpoint has failed.
        """
        self.has_begun = True
        failure = self.endpoint.failure
        if failure:
            _log.error("%s", failure)
        if self.supervisor_left:
            return self._fail_without_supervisor()
        begun = self._begun()
        running = _live(begun)
        if running and self.config.on_stop == "keep":
            self.keeps = True
            self._inform_master(begun)
            keep = counted(len(running), "process keeps", "processes keep")
            _log.info(
                "slave of %s ended (%s); %s running (supervisor pid %d). Start the slave again to "
                "manage them, or stop them by `rosrm slave %s` with the same --config",
                self.config.host, cause or "refused", keep, self.supervisor.pid, STOP_ALL,
            )  # fmt: skip
            return 1 if failure else 0
        live = self.state.live()
        if live and failure and cause != STOP_ALL:
            count = counted(live, "process keeps", "processes keep")
            _log.error(
                "%s running, those with a fence until it expires; correct the error and start the "
                "slave again", count,
            )  # fmt: skip
            return 1
        if live:
            count = counted(live, "process", "processes")
            self._kill_at = self._next_kill()
            _log.info("stopping %s (%s)%s", count, cause or "refused", self._kill_after())
        self.starter.close()
        self._inform_master()
        return self._stop_processes(1 if failure else 0, live, cause)

    def log_progress(self) -> None:
        """Log the processes that still stop and the time until SIGKILL, after another signal."""
        left = _live(self._begun())
        if self._kill_at and left:
            names = listed(str(one.instance) for one in left)
            _log.info("still stopping %s%s", names, self._kill_after())

    def _fail_without_supervisor(self) -> int:
        left = _live(self._begun())
        if left:
            _log.error(
                "%s may still run: %s. Start the slave again, or stop them by `rosrm slave %s` "
                "with the same --config",
                listed(str(one.instance) for one in left), self._supervisor_fault, STOP_ALL,
            )  # fmt: skip
        return 1

    def _stop_processes(self, code: int, live: int, cause: str) -> int:
        longest = self._longest_stop()
        self._kill_at = self._next_kill()  # again, because the master's answer may take a while
        self.supervisor.shut_down()
        self._serve_for(longest)
        if not self.supervisor_left:
            self._kill(longest)
        if not self.supervisor_left:
            _log.error("not ended within %g s: %s", longest, self._unfinished())
            return 1
        if self._supervisor_fault:
            _log.error("%s", self._supervisor_fault)
            return self._fail_without_supervisor()
        if _live(self._begun()):  # the supervisor waits for none that SIGKILL does not end
            self._supervisor_fault = "SIGKILL has not ended processes that the supervisor left"
            return self._fail_without_supervisor()
        self.endpoint.wait_until_received()
        part = "supervisor" if cause == STOP_ALL else "slave"
        count = counted(live, "process was stopped", "processes were stopped")
        _log.info("%s of %s ended; %s", part, self.config.host, count)
        return code

    def _serve_for(self, seconds: float) -> None:
        deadline = clocks.awake_time() + seconds
        self.serve(lambda: not self.supervisor_left and clocks.awake_time() < deadline)

    def _kill(self, longest: float) -> None:
        """Kill what has not ended, whatever its `stop` was in the release that started it."""
        left = [one.instance for one in _live(self._begun())]
        if left:
            names = listed(map(str, left))
            _log.warning("killing (SIGKILL) %s, not ended within %g s", names, longest)
        for instance in left:
            self.supervisor.carry_out(commands.Fence(instance))
        self._serve_for(_KILL_PATIENCE)

    def _inform_master(self, running: Sequence[InstanceStatus] = ()) -> None:
        """Report the end of this slave, and wait for the master's acknowledgement or a time-out."""

        def informed() -> None:
            self._is_informed = True

        try:
            self.endpoint.leave(informed, running)
        except Exception as fault:  # noqa: BLE001 - the processes are to be stopped all the same
            _log.warning(
                "the master was not informed that this slave ends: %s", describe_fault(fault)
            )
            return
        deadline = clocks.boot_time() + _LEAVE_PATIENCE
        self.serve(lambda: not self._is_informed and clocks.boot_time() < deadline)

    def _begun(self) -> list[InstanceStatus]:
        """Return the statuses of all instances except those that still wait for their start."""
        return [one for one in self.state.statuses() if self.starter.has_begun(one.instance)]

    def _longest_stop(self) -> float:
        unknown = LONGEST_STOP  # of a re-adopted process
        longest = [unknown if stop is None else stop.timeout for stop in self._stops()]
        return min(max(longest, default=StopPolicy().timeout), LONGEST_STOP)

    def _next_kill(self) -> float:
        """Return the latest awake time of SIGKILL; infinite if a `stop` is unknown."""
        graces = [
            math.inf if stop is None else stop.interrupt_grace + stop.terminate_grace
            for stop in self._stops()
        ]
        return clocks.awake_time() + max(graces, default=0.0)

    def _stops(self) -> list[StopPolicy | None]:
        alive = self.state.alive.values()
        return [None if held.spec is None else held.spec.stop for held in alive]

    def _kill_after(self) -> str:
        """Return the end of a sentence with the time until SIGKILL; "": unknown, or it was sent."""
        left = self._kill_at - clocks.awake_time()
        if not 0.0 < left < math.inf:
            return ""
        return f"; processes that run after {math.ceil(left)} s are killed (SIGKILL)"

    def _unfinished(self) -> str:
        """Return a sentence with the last known state of each process that has not ended."""
        left = _live(self._begun())
        supervisor = f"the supervisor (pid {self.supervisor.pid})"
        stopping = [str(one.instance) for one in left if one.state is InstanceState.STOPPING]
        running = [str(one.instance) for one in left if one.state is not InstanceState.STOPPING]
        if running:
            also = f"still stops {listed(stopping)} and " if stopping else ""
            return (
                f"{supervisor} {also}has not begun to stop {listed(running)}. Stop them by "
                f"`rosrm slave {STOP_ALL}` with the same --config"
            )
        return f"{supervisor} still stops {listed(stopping or ['what they left'])}"


def _live(statuses: Sequence[InstanceStatus]) -> list[InstanceStatus]:
    return [one for one in statuses if not one.state.ended]
