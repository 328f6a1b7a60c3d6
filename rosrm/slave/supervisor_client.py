"""Connection of the slave to its supervisor: orders are sent at once, a thread receives."""

from __future__ import annotations

import contextlib
import logging
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from rosrm import clocks, threads
from rosrm.artifacts.cache import without_directories
from rosrm.component.link import FAILED, fault_in
from rosrm.config.settings import LogSettings
from rosrm.core.slave import commands, events
from rosrm.core.supervisor import events as orders
from rosrm.errors import SupervisorError, assert_never, describe_fault
from rosrm.model.values import Amendment, InstanceId, InstanceState, InstanceStatus
from rosrm.runtime.log_tail import last_lines
from rosrm.slave.instance_group import InstanceGroup
from rosrm.slave.launch.environment import SHADOW
from rosrm.slave.memos import from_memo, to_memo
from rosrm.supervisor import messages
from rosrm.supervisor.client import (
    SupervisorClient,
    SupervisorEnded,
    SupervisorGone,
    SupervisorSilent,
    log_path,
)
from rosrm.supervisor.client_values import (
    Amended,
    LaunchOrder,
    SupervisorMessage,
    key_of,
    restart_rule,
    run_limits,
)
from rosrm.supervisor.logs import LogLimits
from rosrm.supervisor.paths import OWN_LOG
from rosrm.wording import counted

_log = logging.getLogger("rosrm.slave")

#: Seconds for a new supervisor to be ready, or for a busy one to answer.
_PATIENCE: Final = 30.0
#: Seconds after which a supervisor counts as one that works; supervisors that may end earlier in a
#: row before there is a pause, which doubles each time; most seconds of a pause.
_STEADY: Final = 10.0
_MOST_BRIEF: Final = 3
_LONGEST_PAUSE: Final = 60.0
#: Maximum time, in seconds, for which a status waits for the log of its component.
_LOG_PATIENCE: Final = 1.0
#: Seconds for which orders may wait before a message to the user.
_LOGGED_AFTER: Final = 5.0
_OF_EARLIER_VERSION: Final = (
    "the supervisor there is of an earlier version, and cannot change limits of a running process"
)


class SupervisorLink:
    """Connection to the current supervisor; a supervisor that was killed is replaced.

    No call blocks the loop: a thread receives the supervisor's messages and connects to the next
    supervisor. Launches that the former supervisor has not acknowledged are sent again to the next
    one; the supervisor starts no instance twice. Other orders during the replacement are lost, but
    core and master repeat them until they are executed. Orders to a supervisor that is stopped by a
    signal wait until it continues.

    Args:
        state: directory of the supervisor.
        logs: limits on the logs of the processes.
        post: schedules a call in the loop; may be called from any thread.
        take: takes events for the core.
        follow: takes each new status of an instance.
        preparing: returns the statuses of instances whose orders are still to be sent.
        ended: called once, when there is no supervisor any more, with the fault; "": the supervisor
            ended as requested.

    Raises:
        SupervisorError: the supervisor cannot be started or reached.
    """

    def __init__(
        self, state: Path, logs: LogSettings, *, post: Callable[[Callable[[], None]], None],
        take: Callable[[events.Event], None], follow: Callable[[InstanceStatus], None],
        ended: Callable[[str], None], preparing: Callable[[], Sequence[InstanceStatus]] = tuple,
    ) -> None:  # fmt: skip
        self.state = state
        self._preparing = preparing
        self._limits = LogLimits(logs.max_bytes, logs.keep, keep_bytes=logs.keep_bytes)
        self._post, self._take, self._follow, self._ended = post, take, follow, ended
        self._is_shutting_down = False
        self._is_closed = False
        self._reader: threads.Thread | None = None
        self._leaves = threading.Event()
        self._absence = ""
        self._logged_waits = False
        self._brief = 0
        self._trouble = ("", 0.0)
        self._unanswered: dict[InstanceId, LaunchOrder] = {}
        self._client = SupervisorClient.connect(state, log=self._limits)

    def close(self) -> None:
        """Close the connection; the supervisor continues to run its instances."""
        self._is_closed = True
        self._leaves.set()
        self._client.close()

    @property
    def pid(self) -> int:
        """Return the pid of the supervisor."""
        return self._client.pid

    @property
    def absence(self) -> str:
        """Return why there is no supervisor and none can be started; "": there is one."""
        return self._absence

    @property
    def unenforced(self) -> Mapping[str, str]:
        """Return limits and scheduling settings to the reasons why they cannot be enforced."""
        return self._client.unenforced

    @property
    def reads_secrets(self) -> bool:
        """Return True if the supervisor reads the secrets of instances."""
        return self._client.reads_secrets

    @property
    def writes_files(self) -> bool:
        """Return True if the supervisor writes the files of instances."""
        return self._client.writes_files

    @property
    def adopts(self) -> bool:
        """Return True if the supervisor can adopt processes."""
        return self._client.adopts

    def group_of(self, instance: InstanceId) -> InstanceGroup:
        """Return the control group of an instance."""
        return InstanceGroup(self._client.groups, instance)

    # --- orders --------------------------------------------------------------------------

    def start(self, launches: Sequence[LaunchOrder]) -> None:
        """Send launch orders; refuse them if no supervisor can be started."""
        if self._absence:
            for launch in launches:
                self._take(events.LaunchRefused(launch.instance, self._absence))
            return
        self._unanswered.update((launch.instance, launch) for launch in launches)
        # The receiving thread detects a killed supervisor and replaces it.
        with contextlib.suppress(SupervisorGone):
            self._client.start(launches)
        self._log_waits()

    def carry_out(self, command: commands.SupervisorCommand) -> None:
        """Send a command of the core."""
        if isinstance(command, commands.Stop | commands.Fence):
            self._unanswered.pop(command.instance, None)
        if isinstance(command, commands.Amend):
            command = self._amendable(command)
        with contextlib.suppress(SupervisorGone):
            self._client.send(_order_of(command))
        self._log_waits()

    def renew(self) -> None:
        """Renew the fences for which a running slave counts as contact, before the core does."""
        with contextlib.suppress(SupervisorGone):
            self._client.send(orders.ContactReported(0.0, clocks.boot_time()))

    def _amendable(self, command: commands.Amend) -> commands.Amend:
        """Return what the supervisor can change of an instance, and refuse the rest."""
        instance, amendment = command.instance, command.amendment
        if amendment.limits is None or self._client.amends_limits:
            return command
        recorded = events.AmendmentRecorded(instance, amendment, _OF_EARLIER_VERSION)
        self._post(partial(self._take, recorded))
        return replace(command, amendment=replace(amendment, limits=None))

    def _log_waits(self) -> None:
        waits = self._client.waits
        if waits > _LOGGED_AFTER and not self._logged_waits:
            _log.info(
                "the supervisor (pid %d) has accepted no order for %.0f s: is it stopped? Orders "
                "wait until it continues",
                self._client.pid, waits,
            )  # fmt: skip
        self._logged_waits = waits > _LOGGED_AFTER

    def shut_down(self) -> None:
        """Order the supervisor to stop all processes and end."""
        self._is_shutting_down = True
        self._leaves.set()
        with contextlib.suppress(SupervisorGone):
            self._client.send(orders.ShutdownOrdered())

    # --- messages ------------------------------------------------------------------------

    def listen(self) -> None:
        """Start the thread that receives messages."""
        threads.start(partial(self._receive_all, self._client), "supervisor", failed=self._deaf)

    def _deaf(self, fault: BaseException) -> None:
        """End the slave, which would receive nothing from the supervisor any more."""
        self._post(partial(self._end, SupervisorError(describe_fault(fault))))

    def _receive_all(self, client: SupervisorClient) -> None:
        """Pass the messages of all successive supervisors to the loop, in a thread of its own."""
        try:
            while True:
                began = clocks.boot_time()
                self._receive(client)
                self._slow_down(client, clocks.boot_time() - began)
                client = self._next()
                self._post(partial(self._replace, client))
        except SupervisorError as error:
            if not self._is_closed:
                self._post(partial(self._end, error))

    def _slow_down(self, client: SupervisorClient, lasted: float) -> None:
        """Pause before the next supervisor if the last ones ended soon after their starts."""
        self._brief = self._brief + 1 if lasted < _STEADY else 0
        if self._brief < _MOST_BRIEF:
            return
        pause = min(2.0 ** (self._brief - _MOST_BRIEF), _LONGEST_PAUSE)
        fault = (
            f"{self._brief} supervisors in a row have ended within {_STEADY:g} s of their start, "
            f"the last one (pid {client.pid}) after {lasted:.1f} s; the next one starts in "
            f"{pause:g} s. {self.state / OWN_LOG} may have the reason"
        )
        self._trouble = (fault, clocks.boot_time() + pause + _STEADY)
        self._leaves.wait(pause)

    def trouble(self, now: float) -> str:
        """Return why supervisors end again and again, or none starts; "": one works."""
        fault, until = (self._absence, math.inf) if self._absence else self._trouble
        return fault.replace(str(self.state), "STATE") if now < until else ""

    def _receive(self, client: SupervisorClient) -> None:
        """Receive until the supervisor must be replaced; raises `SupervisorError` at the end."""
        try:
            while True:
                received = [self._explained(one) for one in client.receive(None)]
                self._post(partial(self._take_messages, received))
        except SupervisorError as gone:  # `SupervisorEnded`: by a SIGTERM to it alone
            if self._leaves.is_set():
                raise
            _log.info("%s; connecting to the next one", gone)

    def _next(self) -> SupervisorClient:
        """Return a connection to the next supervisor, or to the same one if it was silent.

        If none can be started, try again with back-off: the slave stays, and reports its instances.
        """
        logged, pauses = False, threads.Pauses()
        while True:
            try:
                client = SupervisorClient.connect(self.state, log=self._limits, timeout=_PATIENCE)
            except SupervisorSilent as silence:
                if self._is_closed:
                    raise
                if not logged:
                    _log.info("%s; waiting until it does", silence)
                logged = True
            except SupervisorError as error:
                if self._leaves.is_set():
                    raise
                pause = pauses.after_fault()
                self._note_absence(str(error), pause)
                self._leaves.wait(pause)
            else:
                self._absence = ""
                return client

    def _note_absence(self, fault: str, pause: float) -> None:
        """Refuse starts from now on, and report those that the former supervisor may have begun."""
        if self._absence != fault:
            _log.error("%s; no process is started here; next try in %g s", fault, pause)
        self._absence = fault
        self._post(partial(self._delay_unanswered, fault))

    def _delay_unanswered(self, fault: str) -> None:
        for instance in self._unanswered:
            self._take(events.StartDelayed(instance, fault))

    def _take_messages(self, received: Sequence[SupervisorMessage]) -> None:
        statuses = tuple(
            replace(one, message=without_directories(one.message))
            for one in received
            if isinstance(one, InstanceStatus)
        )
        for status in statuses:
            self._unanswered.pop(status.instance, None)
            self._follow(status)
        self._take(events.SupervisorReported(statuses))
        for one in received:
            if isinstance(one, Amended):
                self._take(events.AmendmentRecorded(one.instance, one.amendment, one.refusal))

    def _explained(self, one: SupervisorMessage) -> SupervisorMessage:
        """Return a status with the reason that a component's process logged, if any.

        Called in the thread that receives. The log may be on a disk without an answer, so another
        thread reads it, and the status waits at most `_LOG_PATIENCE` seconds.
        """
        code = f"exit code {FAILED}"
        if not isinstance(one, InstanceStatus) or not one.message.startswith(code):
            return one
        faults: list[str] = []

        def read() -> None:
            faults.append(fault_in(last_lines(log_path(self.state, one.instance))))

        if self._reader is None or not self._reader.is_alive():
            with contextlib.suppress(RuntimeError):  # no further thread: the reason is in the log
                self._reader = threads.start(read, "log of a component")
                self._reader.join(_LOG_PATIENCE)
        if not any(faults):
            return one
        return replace(one, message=one.message.replace(code, f"{code}: {faults[0]}", 1))

    def take_over(self) -> int:
        """Re-adopt the supervisor's instances, and return their number; no others run."""
        client = self._client
        for note in client.notes:
            _log.info("%s", note)
        for status in client.instances:
            self._follow(status)
        found = {one: from_memo(memo) for one, memo in client.memos.items()}
        memos = {one: memo for one, memo in found.items() if memo is not None}
        statuses = [*client.instances, *self._launch_again(client), *self._preparing()]
        replaced = events.SupervisorReplaced(
            tuple(statuses), memos, client.fenced, client.holds_starts
        )
        self._take(replaced)
        return len(client.instances)

    def _launch_again(self, client: SupervisorClient) -> list[InstanceStatus]:
        """Repeat the launch orders that no supervisor has acknowledged; return their statuses."""
        for status in client.instances:
            self._unanswered.pop(status.instance, None)
        if not client.holds_starts:  # an earlier version would start a held job at once
            self._unanswered = {
                one: order for one, order in self._unanswered.items() if not order.slots
            }
        with contextlib.suppress(SupervisorGone):
            client.start(list(self._unanswered.values()))
        return [
            InstanceStatus(one, InstanceState.HELD if order.slots else InstanceState.STARTING)
            for one, order in self._unanswered.items()
        ]

    def _replace(self, client: SupervisorClient) -> None:
        """Replace the connection, and re-adopt the instances."""
        former = self._client
        former.close()
        self._client = client
        if self._is_closed:
            client.close()
            return
        self.take_over()
        live = sum(not status.state.ended for status in client.instances) + len(self._unanswered)
        which = "the same" if client.pid == former.pid else "a new"
        manages = counted(live, "process", "processes")
        _log.info("%s supervisor (pid %d) manages %s", which, client.pid, manages)
        if self._is_shutting_down:  # the former one may have missed it
            self.shut_down()

    def _end(self, error: SupervisorError) -> None:
        """Report the orderly end of the supervisor, or its failure without a successor."""
        orderly = isinstance(error, SupervisorEnded)
        self._ended("" if orderly else f"the supervisor of this host is gone: {error}")


def amended(order: LaunchOrder, amendment: Amendment) -> LaunchOrder:
    """Return an order with the changes that the supervisor would make by `commands.Amend`."""
    environment = {name: value for name, value in order.environment.items() if name != SHADOW}
    limits = order.limits.with_limits(run_limits(amendment.limits))
    return replace(order, restart=amendment.restart, limits=limits, environment=environment)


def _order_of(command: commands.SupervisorCommand) -> messages.Order:
    """Return a command of the core as an order to the supervisor."""
    order: messages.Order
    match command:
        case commands.Stop(instance):
            order = orders.StopOrdered(key_of(instance))
        case commands.Fence(instance):
            order = orders.FenceOrdered(key_of(instance))
        case commands.Restart(instance, run):
            meant = None if run is None else (run.pid, run.restarts)
            order = orders.RestartOrdered(key_of(instance), meant)
        case commands.Renew(at, alive):
            order = orders.ContactReported(at, alive)
        case commands.Fail(instance, pid, reason, kill):
            order = orders.FailOrdered(key_of(instance), pid, reason, kill)
        case commands.Amend(instance, amendment):
            restart, limits = restart_rule(amendment.restart), run_limits(amendment.limits)
            order = messages.Amend(key_of(instance), restart, {SHADOW: None}, limits)
        case commands.Remember(instance, memo):
            order = messages.Remember(key_of(instance), to_memo(memo))
        case commands.Forget(instances):
            order = messages.Forget(tuple(orders.StatusStored(key_of(one)) for one in instances))
        case _:
            assert_never(command)
    return order
