"""The slave's end of its supervisor: orders go out at once, words come in by a thread."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from rosrm.config.settings import LogSettings
from rosrm.core.slave import reducer as core
from rosrm.errors import SupervisorError
from rosrm.model.values import InstanceId, InstanceState, InstanceStatus
from rosrm.slave.launch.environment import SHADOW
from rosrm.slave.memos import from_memo, to_memo
from rosrm.supervisor.client import (
    Amended,
    LaunchOrder,
    LogLimits,
    SupervisorClient,
    SupervisorEnded,
    SupervisorGone,
    SupervisorSilent,
    Told,
)
from rosrm.wording import counted

#: Seconds for another supervisor to be ready, or for one that is busy to answer.
_PATIENCE: Final = 30.0
#: Seconds for which orders may wait before the user hears of it.
_TOLD_AFTER: Final = 5.0


class SupervisorLink:
    """One supervisor after the other: one that was killed is replaced, and takes over.

    Nothing here makes the loop wait: a thread hears the supervisor and finds the next one. Launches
    that the former one has said nothing of are given to the next one again: that starts nothing
    twice. Other orders that come meanwhile are lost; the core and the master give them again, as
    long as they are not followed. Orders to one that is stopped wait until it goes on.

    Args:
        state: directory of the supervisor.
        logs: bounds of what the processes print.
        post: has something called in the loop; may be called from any thread.
        take: takes in what happened.
        follow: told of each new status of an instance.
        say: tells the user.
        ended: called once, when there is no supervisor any more: with what is wrong; "": it has
            ended as it was told to.

    Raises:
        SupervisorError: the supervisor cannot be started or reached.
    """

    def __init__(
        self, state: Path, logs: LogSettings, *, post: Callable[[Callable[[], None]], None],
        take: Callable[[core.Event], None], follow: Callable[[InstanceStatus], None],
        say: Callable[[str], None], ended: Callable[[str], None],
    ) -> None:  # fmt: skip
        self.state = state
        self._limits = LogLimits(logs.max_bytes, logs.keep)
        self._post, self._take, self._follow = post, take, follow
        self._say, self._ended = say, ended
        self._is_shutting_down = False
        self._is_closed = False
        self._told_waits = False
        self._unanswered: dict[InstanceId, LaunchOrder] = {}
        self._client = SupervisorClient.connect(state, log=self._limits)

    def close(self) -> None:
        """Leave it; it goes on with what it has."""
        self._is_closed = True
        self._client.close()

    @property
    def pid(self) -> int:
        """Pid of the supervisor."""
        return self._client.pid

    # --- what it is told -----------------------------------------------------------------

    def start(self, orders: Sequence[LaunchOrder]) -> None:
        """Have instances started."""
        self._unanswered.update((order.instance, order) for order in orders)
        # One that was killed takes no order; its reader says so, and it is replaced.
        with contextlib.suppress(SupervisorGone):
            self._client.start(orders)
        self._say_if_it_waits()

    def carry_out(self, command: core.Command) -> None:
        """Have done what the core asks of it."""
        with contextlib.suppress(SupervisorGone):
            self._tell(command)
        self._say_if_it_waits()

    def _say_if_it_waits(self) -> None:
        waits = self._client.waits
        if waits > _TOLD_AFTER and not self._told_waits:
            self._say(
                f"the supervisor (pid {self._client.pid}) has accepted no order for {waits:.0f} s: "
                f"is it stopped? Orders wait until it continues"
            )
        self._told_waits = waits > _TOLD_AFTER

    def _tell(self, command: core.Command) -> None:
        client = self._client
        if isinstance(command, core.Stop | core.Fence):
            self._unanswered.pop(command.instance, None)
        if isinstance(command, core.Stop):
            client.stop(command.instance)
        elif isinstance(command, core.Fence):
            client.fence(command.instance)
        elif isinstance(command, core.Restart):
            client.restart(command.instance)
        elif isinstance(command, core.Renew):
            client.heard(command.at, command.alive)
        elif isinstance(command, core.Fail):
            client.fail(command.instance, command.pid, command.reason, kill=command.kill)
        elif isinstance(command, core.Amend):
            client.amend(command.instance, command.restart, {SHADOW: None})
        elif isinstance(command, core.Remember):
            client.remember(command.instance, to_memo(command.memo))
        elif isinstance(command, core.Forget):
            client.forget(command.instances)
        else:
            raise TypeError(command)

    def shut_down(self) -> None:
        """Have it stop all processes, and end."""
        self._is_shutting_down = True
        with contextlib.suppress(SupervisorGone):
            self._client.shutdown()

    # --- what it tells -------------------------------------------------------------------

    def listen(self) -> None:
        """Hear it from now on."""
        thread = threading.Thread(
            target=self._hear_all, args=[self._client], name="supervisor", daemon=True
        )
        thread.start()

    def _hear_all(self, client: SupervisorClient) -> None:
        """Runs in a thread of its own: the words of one after the other, into the loop."""
        try:
            while True:
                self._hear(client)
                client = self._next()
                self._post(partial(self._replace, client))
        except SupervisorError as error:
            if not self._is_closed:
                self._post(partial(self._end, error))

    def _hear(self, client: SupervisorClient) -> None:
        """Until another one is to take over; raises SupervisorError where none is."""
        try:
            while True:
                told = client.receive(None)
                self._post(partial(self._take_told, told))
        except (SupervisorGone, SupervisorEnded) as gone:  # ended: by a SIGTERM to it alone
            if self._is_shutting_down or self._is_closed:
                raise
            self._post(partial(self._say, f"{gone}; connecting to the next one"))

    def _next(self) -> SupervisorClient:
        """The one that takes over, or the same, where it took no orders."""
        told = False
        while True:
            try:
                return SupervisorClient.connect(self.state, log=self._limits, timeout=_PATIENCE)
            except SupervisorSilent as silence:
                if self._is_closed:
                    raise
                if not told:
                    self._post(partial(self._say, f"{silence}; waiting until it does"))
                told = True

    def _take_told(self, told: Sequence[Told]) -> None:
        statuses = tuple(one for one in told if isinstance(one, InstanceStatus))
        for status in statuses:
            self._unanswered.pop(status.instance, None)
            self._follow(status)
        self._take(core.SupervisorReported(statuses))
        for one in told:
            if isinstance(one, Amended):
                self._take(core.RestartPolicyRecorded(one.instance, one.restart))

    def take_over(self) -> int:
        """Take in what the supervisor knows; what it does not know does not run.

        Returns:
            how many instances it holds.
        """
        client = self._client
        for note in client.notes:
            self._say(note)
        for status in client.instances:
            self._follow(status)
        found = {one: from_memo(memo) for one, memo in client.memos.items()}
        memos = {one: memo for one, memo in found.items() if memo is not None}
        statuses = [*client.instances, *self._launch_again(client)]
        self._take(core.SupervisorReplaced(tuple(statuses), memos, client.fenced))
        return len(client.instances)

    def _launch_again(self, client: SupervisorClient) -> list[InstanceStatus]:
        """Have started what the former one did not take; what it took the next one knows."""
        for status in client.instances:
            self._unanswered.pop(status.instance, None)
        with contextlib.suppress(SupervisorGone):
            client.start(list(self._unanswered.values()))
        return [InstanceStatus(one, InstanceState.STARTING) for one in self._unanswered]

    def _replace(self, client: SupervisorClient) -> None:
        """Another one is there."""
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
        self._say(f"{which} supervisor (pid {client.pid}) manages {manages}")
        if self._is_shutting_down:  # the former one may not have heard of it
            self.shut_down()

    def _end(self, error: SupervisorError) -> None:
        """It has ended as it was told to; or it is gone, and there is no other one."""
        orderly = isinstance(error, SupervisorEnded)
        self._ended("" if orderly else f"the supervisor of this host is gone: {error}")
