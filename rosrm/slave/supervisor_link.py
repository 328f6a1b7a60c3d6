"""The slave's end of its supervisor: orders go out at once, words come in by a thread."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from rosrm.config.settings import LogSettings
from rosrm.core import slave as core
from rosrm.core.model import InstanceStatus
from rosrm.errors import SupervisorError
from rosrm.slave.environment import SHADOW
from rosrm.slave.memos import from_memo, to_memo
from rosrm.supervisor.client import (
    Amended,
    LaunchOrder,
    LogLimits,
    SupervisorClient,
    SupervisorEnded,
    SupervisorGone,
    Told,
)


class SupervisorLink:
    """One supervisor after the other: one that was killed is replaced, and takes over.

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
        self._client = self._connect()

    def _connect(self) -> SupervisorClient:
        return SupervisorClient.connect(self.state, log=self._limits)

    def close(self) -> None:
        """Leave it; it goes on with what it has."""
        self._client.close()

    # --- what it is told -----------------------------------------------------------------

    def start(self, orders: Sequence[LaunchOrder]) -> None:
        """Have instances started."""
        # One that was killed takes no order; its reader says so, and it is replaced.
        with contextlib.suppress(SupervisorGone):
            self._client.start(orders)

    def carry_out(self, command: core.Command) -> None:
        """Have done what the core asks of it."""
        with contextlib.suppress(SupervisorGone):
            self._tell(command)

    def _tell(self, command: core.Command) -> None:
        client = self._client
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
        threading.Thread(target=self._read, name="supervisor", daemon=True).start()

    def _read(self) -> None:
        """Runs in a thread of its own: the supervisor's words, into the loop."""
        while True:
            try:
                told = self._client.receive(None)
            except SupervisorError as error:
                self._post(partial(self._gone, error))
                return
            self._post(partial(self._take_told, told))

    def _take_told(self, told: Sequence[Told]) -> None:
        statuses = tuple(one for one in told if isinstance(one, InstanceStatus))
        for status in statuses:
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
        self._take(core.SupervisorReplaced(client.instances, memos, client.fenced))
        return len(client.instances)

    def _gone(self, error: SupervisorError) -> None:
        """It has ended as it was told to; or it was killed, and another one takes over."""
        if isinstance(error, SupervisorGone) and not self._is_shutting_down:
            self._say(f"{error}; starting another one")
            try:
                self._client.close()
                self._client = self._connect()
            except SupervisorError as failure:
                error = failure
            else:
                self.listen()
                self.take_over()
                return
        orderly = isinstance(error, SupervisorEnded)
        self._ended("" if orderly else f"the supervisor of this host is gone: {error}")
