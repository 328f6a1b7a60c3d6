"""The slave's side of its supervisor."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rosrm.core.supervisor.reducer import (
    AmendOrdered,
    FailOrdered,
    FenceOrdered,
    Forgotten,
    Heard,
    RestartOrdered,
    ShutdownOrdered,
    StopOrdered,
)
from rosrm.errors import SupervisorError
from rosrm.model.values import InstanceId, InstanceStatus, RestartPolicy
from rosrm.supervisor import json_lines, messages, paths
from rosrm.supervisor.client_values import (
    Amended,
    LaunchOrder,
    Told,
    fence_rule,
    key_of,
    restart_rule,
    status_from,
    stop_rule,
)
from rosrm.supervisor.discovery import connect_or_start, readable
from rosrm.supervisor.logs import LogLimits
from rosrm.supervisor.send_buffer import MOST_UNSENT, Outgoing, Overfull

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = [
    "Amended",
    "LaunchOrder",
    "LogLimits",
    "SupervisorClient",
    "SupervisorEnded",
    "SupervisorGone",
    "SupervisorSilent",
    "Told",
    "log_path",
    "logged_instances",
    "newest_log",
]

DEFAULT_LOG_LIMITS: Final = LogLimits()
_CHUNK: Final = 1 << 16


class SupervisorGone(SupervisorError):
    """The connection was lost: the supervisor was killed, or takes no orders.

    Connect again: a new one takes over, or the same tells what it has taken.
    """


class SupervisorSilent(SupervisorError):
    """It is there and does not answer: it is stopped, or its machine is too busy. Try again."""


class SupervisorEnded(SupervisorError):
    """The shutdown that was asked for is complete: nothing runs any more."""


def log_path(state_directory: Path, instance: InstanceId) -> Path:
    """The file that an instance writes its output to; older parts: `.1`, `.2`, ... behind it."""
    return Path(paths.log_file(str(state_directory), instance.process, instance.number))


def logged_instances(state_directory: Path, process: str) -> list[int]:
    """Return the numbers of the instances of a process that have a log, ascending."""
    wanted = paths.safe_name(process)
    folder = Path(paths.log_folder(str(state_directory)))
    found = [paths.log_number(path.name) for path in folder.glob("*.log")]
    return sorted(log[1] for log in found if log is not None and log[0] == wanted)


def newest_log(state_directory: Path, process: str) -> InstanceId | None:
    """The newest instance of a process that has a log; None: there is none (any more)."""
    numbers = logged_instances(state_directory, process)
    return InstanceId(process, numbers[-1]) if numbers else None


class SupervisorClient:
    """A connection to the supervisor of this host.

    To order never waits: what the supervisor does not take at once is sent when it does, in order.
    One thread may wait in `receive` while others order.

    Attributes:
        instances: what the supervisor knew when the connection was made: every instance that has
            not been forgotten, final statuses included.
        memos: what an earlier client wanted to be remembered of those that have not ended.
        fenced: those that have a fence.
        notes: what the supervisor found wrong with its record, for people.
        pid: of the supervisor.
    """

    def __init__(self, peer: socket.socket, state_directory: Path) -> None:
        self._peer = peer
        self._outgoing = Outgoing(peer)
        self._state = state_directory
        self._lines = json_lines.Lines()
        self._received: list[Told] = []
        self._failure: SupervisorError | None = None
        self._ending = False
        self._sending = threading.Lock()
        self._base: Mapping[str, str] | None = None
        self._base_id = ""
        self.instances: tuple[InstanceStatus, ...] = ()
        self.memos: Mapping[InstanceId, str] = {}
        self.fenced: frozenset[InstanceId] = frozenset()
        self.notes: tuple[str, ...] = ()
        self.pid = 0

    @classmethod
    def connect(
        cls,
        state_directory: Path,
        *,
        start: bool = True,
        log: LogLimits = DEFAULT_LOG_LIMITS,
        timeout: float = 5.0,
    ) -> SupervisorClient:
        """Connect to the supervisor of a state directory, and start one where none listens.

        Raises:
            SupervisorSilent: there is one, and it does not answer in time.
            SupervisorError: there is none and none can be started in time, or it turned us down.
        """
        state = Path(os.path.abspath(state_directory))
        deadline = time.monotonic() + timeout
        while True:
            client = cls(connect_or_start(state, start, log, deadline), state)
            try:
                client._introduce(log, deadline)
            except SupervisorGone:
                # A supervisor that is just dying still takes connections for an instant.
                client.close()
                if time.monotonic() > deadline:
                    raise
            except BaseException:
                client.close()
                raise
            else:
                return client

    # --- orders -------------------------------------------------------------------------------

    def start(self, orders: Sequence[LaunchOrder]) -> None:
        """Have instances started; repeating an order starts nothing twice."""
        with self._sending:
            if orders and self._base is None:
                self._choose_base(orders[0].environment)
            self._send(b"".join(messages.encode_order(self._launch(order)) for order in orders))

    def stop(self, instance: InstanceId) -> None:
        """SIGINT, SIGTERM, SIGKILL to all of it; never heard of: it will never be started."""
        self._order(StopOrdered(key_of(instance)))

    def fence(self, instance: InstanceId) -> None:
        """SIGKILL to all of it, and no restart; never heard of: it will never be started."""
        self._order(FenceOrdered(key_of(instance)))

    def heard(self, at: float, alive: float) -> None:
        """Fences wait: the master is known to have heard this host, and this slave was at work.

        Args:
            at, alive: monotonic times of that.

        Left out while the supervisor does not read (it is stopped): a newer one will follow.
        """
        if self._outgoing.is_free:
            self._order(Heard(at, alive))

    def restart(self, instance: InstanceId) -> None:
        """Stop it, then start it again; the restart policy does not count this."""
        self._order(RestartOrdered(key_of(instance)))

    def fail(self, instance: InstanceId, pid: int, reason: str, *, kill: bool) -> None:
        """A run of it counts as failed: stop it, then do as its restart policy says.

        Args:
            pid: of the run; where it has ended meanwhile nothing is done.
            reason: for people.
            kill: SIGKILL at once; otherwise it is asked first.
        """
        self._order(FailOrdered(key_of(instance), pid, reason, kill))

    def amend(
        self, instance: InstanceId, restart: RestartPolicy, changes: Mapping[str, str | None]
    ) -> None:
        """Give it another restart policy; answered by `Amended`, of what has ended too.

        Args:
            changes: of its environment when it starts again; None: without this variable.
        """
        order = AmendOrdered(key_of(instance), restart_rule(restart))
        self._order(messages.Amend(order, changes))

    def remember(self, instance: InstanceId, memo: str) -> None:
        """Keep another text for a later run of the client."""
        self._order(messages.Remember(key_of(instance), memo))

    def forget(self, instances: Iterable[InstanceId]) -> None:
        """Their final statuses are kept elsewhere now: the supervisor need not."""
        forgotten = tuple(Forgotten(key_of(instance)) for instance in instances)
        if forgotten:
            self._order(messages.Forget(forgotten))

    def shutdown(self) -> None:
        """Stop everything, then end the supervisor; `receive` tells all of it."""
        self._order(ShutdownOrdered())

    # --- answers ------------------------------------------------------------------------------

    @property
    def waits(self) -> float:
        """Seconds for which it has taken none of the orders that wait for it; 0.0: none waits."""
        return self._outgoing.waits

    def fileno(self) -> int:
        """Readable when `receive` has something; for a selector."""
        return self._peer.fileno()

    def receive(self, timeout: float | None = None) -> list[Told]:
        """What the supervisor has told, oldest first; [] when nothing came in time.

        Raises:
            SupervisorEnded: the shutdown is complete.
            SupervisorGone: it was killed; its processes go on.
            SupervisorError: it turned us down, or cannot be understood.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self._received:
            if self._failure is not None:
                raise self._failure
            wait = None if deadline is None else max(0.0, deadline - time.monotonic())
            if not readable(self._peer, wait):
                return []
            self._read()
        received, self._received = self._received, []
        return received

    def close(self) -> None:
        """Leave; the instances go on."""
        self._outgoing.close()

    def __enter__(self) -> Self:
        """The connection is closed with the block."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()

    # --- sending ------------------------------------------------------------------------------

    def _launch(self, order: LaunchOrder) -> messages.Launch:
        base = self._base or {}
        changes: dict[str, str | None] = {
            name: value for name, value in order.environment.items() if base.get(name) != value
        }
        changes.update((name, None) for name in base if name not in order.environment)
        return messages.Launch(
            key_of(order.instance),
            order.argv,
            self._base_id,
            changes,
            order.working_directory,
            restart_rule(order.restart),
            stop_rule(order.stop),
            order.memo,
            fence_rule(order.fence),
            order.heard,
        )

    def _choose_base(self, environment: Mapping[str, str]) -> None:
        """Environments differ little: send one whole, and of the others what differs from it."""
        self._base = dict(environment)
        self._base_id = os.urandom(8).hex()
        self._send(messages.encode_order(messages.Environment(self._base_id, self._base)))

    def _order(self, order: messages.Order) -> None:
        with self._sending:
            self._send(messages.encode_order(order))

    def _send(self, data: bytes) -> None:
        try:
            self._outgoing.send(data)
        except Overfull:
            most = f"{MOST_UNSENT >> 20} MiB"
            full = SupervisorGone(f"{self._name()} takes no orders, and {most} of them wait for it")
            self._fail(full)  # before the reader sees that the connection has ended
            self._outgoing.drop()
            raise full from None
        except OSError as error:
            raise SupervisorGone(f"{self._name()} is gone: {error.strerror}") from None

    # --- receiving ----------------------------------------------------------------------------

    def _introduce(self, log: LogLimits, deadline: float) -> None:
        self._order(messages.Hello(messages.PROTOCOL, os.getpid(), log))
        while not self.pid:
            if self._failure is not None:
                raise self._failure
            if not readable(self._peer, max(0.0, deadline - time.monotonic())):
                raise SupervisorSilent(f"{self._name()} did not answer in time")
            self._read()

    def _read(self) -> None:
        try:
            data = self._peer.recv(_CHUNK, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return
        except OSError as error:
            self._lose(f"{self._name()} is gone: {error.strerror}")
            return
        if not data:
            self._lose(f"{self._name()} is gone; its processes go on")
        try:
            for line in self._lines.feed(data):
                self._take(json_lines.parse(line))
        except (json_lines.ProtocolError, KeyError, TypeError, ValueError) as error:
            self._fail(SupervisorError(f"{self._name()} cannot be understood: {error}"))

    def _lose(self, reason: str) -> None:
        """Note that the connection has ended: after `ended`, also by orders that nobody read."""
        if self._ending:
            self._fail(SupervisorEnded(f"{self._name()} has ended, and all its processes"))
        else:
            self._fail(SupervisorGone(reason))

    def _take(self, fields: Mapping[str, object]) -> None:
        told = fields["tell"]
        if told == "status":
            self._received.append(status_from(fields["status"]))
        elif told == "amended":
            instance = InstanceId(*messages.read_key(fields["instance"]))
            rule = messages.read_restart(fields["restart"])  # type: ignore[arg-type]
            self._received.append(Amended(instance, RestartPolicy(*rule)))
        elif told == "welcome":
            self._take_welcome(fields)
        elif told == "refused":
            self._fail(SupervisorError(str(fields["message"])))
        elif told == "ended":
            self._ending = True
        else:
            raise ValueError(f"it tells {told!r}, which this version does not know")

    def _take_welcome(self, fields: Mapping[str, object]) -> None:
        number, pid = fields["protocol"], fields["pid"]
        if number != messages.PROTOCOL:
            raise ValueError(f"it speaks protocol {number!r}, this is {messages.PROTOCOL}")
        notes, instances, memos = fields["notes"], fields["instances"], fields["memos"]
        fenced = fields["fenced"]
        assert isinstance(pid, int)
        assert isinstance(notes, list)
        assert isinstance(instances, list)
        assert isinstance(memos, list)
        assert isinstance(fenced, list)
        self.pid = pid
        self.notes = tuple(str(note) for note in notes)
        self.instances = tuple(status_from(value) for value in instances)
        self.fenced = frozenset(InstanceId(*messages.read_key(key)) for key in fenced)
        self.memos = {InstanceId(*messages.read_key(key)): str(memo) for key, memo in memos}

    def _fail(self, failure: SupervisorError) -> None:
        """Remember what ends the connection; what came before it is delivered first."""
        if self._failure is None:
            self._failure = failure

    def _name(self) -> str:
        pid = f" (pid {self.pid})" if self.pid else ""
        return f"the supervisor{pid} of {self._state}"
