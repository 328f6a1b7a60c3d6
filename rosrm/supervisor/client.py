"""Client of the supervisor, used by the slave."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rosrm import clocks
from rosrm.core.supervisor.events import ContactReported
from rosrm.errors import SupervisorError
from rosrm.model.start_trace import stamped_in
from rosrm.model.values import InstanceId, InstanceStatus
from rosrm.runtime.state_lock import closed_in_forks
from rosrm.supervisor import json_lines, messages, paths
from rosrm.supervisor.client_values import (
    Amended,
    LaunchOrder,
    SupervisorMessage,
    amendment_from,
    fence_rule,
    key_of,
    restart_rule,
    status_from,
    stop_rule,
)
from rosrm.supervisor.discovery import connect_or_start, readable
from rosrm.supervisor.logs import LogLimits
from rosrm.supervisor.send_buffer import MOST_UNSENT, Outgoing, Overfull
from rosrm.wording import reason_of

if TYPE_CHECKING:
    from typing_extensions import Self

DEFAULT_LOG_LIMITS: Final = LogLimits()
_CHUNK: Final = 1 << 16
#: Seconds for the start of a supervisor; a host that boots is busy.
_TIMEOUT: Final = 15.0
#: Answer of a supervisor of an earlier version, which knows no limits.
_NOTHING_ENFORCED: Final = dict.fromkeys(
    ("limits.memory", "limits.memory_high", "limits.cpu", "realtime", "nice"),
    "a supervisor of an earlier version runs; it ends when all its processes have ended",
)


class SupervisorGone(SupervisorError):
    """The connection was lost: the supervisor was killed, or reads no orders.

    Connect again: a new supervisor takes over, or the same one reports the orders that it received.
    """


class SupervisorSilent(SupervisorError):
    """The supervisor exists but does not answer: it is stopped, or its machine is busy. Retry."""


class SupervisorEnded(SupervisorError):
    """The ordered shutdown is complete: no process runs any more."""


def log_path(state_directory: Path, instance: InstanceId) -> Path:
    """Return the log file of an instance; older parts have `.1`, `.2`, ... appended."""
    return Path(paths.log_file(str(state_directory), instance.process, instance.number))


#: Seconds before the next attempt to connect, after a first and a later supervisor that has ended.
_FIRST_PAUSE: Final = 0.02
_LONGEST_PAUSE: Final = 2.0


class SupervisorClient:
    """A connection to the supervisor of this host.

    Sending an order never blocks: orders that the supervisor does not read at once are queued and
    sent later, in order. One thread may wait in `receive` while others send orders.

    Attributes:
        instances: statuses at the time of connecting: every instance that has not been forgotten,
            final statuses included.
        memos: texts that an earlier client stored for instances that have not ended.
        fenced: instances that have a fence.
        unenforced: limit or scheduling setting to the reason why it cannot be enforced here.
        groups: version, directory and controllers of each tree of the instances' control groups.
        reads_secrets: it reads the secrets of instances; one of an earlier version does not.
        amends_limits: it can change the limits of a running instance; one of an earlier version
            cannot.
        adopts: it can adopt processes; one of an earlier version cannot.
        holds_starts: it holds a start until a slot is free; one of an earlier version starts at
            once.
        writes_files: it writes the files of instances; one of an earlier version does not.
        notes: faults that the supervisor found in its record, as text for the user.
        pid: of the supervisor.
    """

    def __init__(self, peer: socket.socket, state_directory: Path) -> None:
        self._peer = peer
        # A child that a plugin forks would hold the connection after the end of this process.
        self._unforked = contextlib.ExitStack()
        self._unforked.enter_context(closed_in_forks(peer.fileno()))
        self._outgoing = Outgoing(peer)
        self._state = state_directory
        self._lines = json_lines.LineSplitter()
        self._received: list[SupervisorMessage] = []
        self._failure: SupervisorError | None = None
        self._ending = False
        self._sending = threading.Lock()
        self._base: Mapping[str, str] | None = None
        self._base_id = ""
        self.instances: tuple[InstanceStatus, ...] = ()
        self.memos: Mapping[InstanceId, str] = {}
        self.fenced: frozenset[InstanceId] = frozenset()
        self.unenforced: Mapping[str, str] = {}
        self.groups: tuple[tuple[int, str, tuple[str, ...]], ...] = ()
        self.reads_secrets = self.amends_limits = self.adopts = self.holds_starts = False
        self.writes_files = False
        self.notes: tuple[str, ...] = ()
        self.pid = 0

    @classmethod
    def connect(
        cls, state_directory: Path, *, start: bool = True, log: LogLimits = DEFAULT_LOG_LIMITS,
        timeout: float = _TIMEOUT,
    ) -> SupervisorClient:  # fmt: skip
        """Connect to the supervisor of a state directory, and start one where none listens.

        Raises:
            SupervisorSilent: a supervisor exists, and does not answer in time.
            SupervisorError: there is none and none can be started in time, or it refused.
        """
        state = Path(os.path.abspath(state_directory))
        deadline, pause = clocks.boot_time() + timeout, _FIRST_PAUSE
        while True:
            try:
                return cls._connect_once(state, start, log, deadline)
            except TimeoutError:
                silent = f"the supervisor of {state} did not answer in time"
                raise SupervisorSilent(silent) from None
            except SupervisorGone:
                # A dying supervisor still accepts connections for an instant.
                if clocks.boot_time() > deadline:
                    raise
                time.sleep(pause)
                pause = min(2.0 * pause, _LONGEST_PAUSE)

    @classmethod
    def _connect_once(
        cls, state: Path, start: bool, log: LogLimits, deadline: float
    ) -> SupervisorClient:
        client = cls(connect_or_start(state, start, log, deadline), state)
        with contextlib.ExitStack() as failing:
            failing.callback(client.close)
            client._introduce(log, deadline)
            failing.pop_all()
        return client

    # --- orders -------------------------------------------------------------------------------

    def start(self, orders: Sequence[LaunchOrder]) -> None:
        """Start instances; a repeated order starts nothing twice."""
        with self._sending:
            if orders and self._base is None:
                self._choose_base(orders[0].environment)
            self._send(b"".join(messages.encode_order(self._launch(order)) for order in orders))

    def send(self, order: messages.Order) -> None:
        """Send an order; skip a contact that would wait, because a newer one follows."""
        if isinstance(order, ContactReported) and not self._outgoing.is_free:
            return
        with self._sending:
            self._send(messages.encode_order(order))

    # --- answers ------------------------------------------------------------------------------

    @property
    def waits(self) -> float:
        """Seconds since the supervisor last read any of the queued orders; 0.0: none is queued."""
        return self._outgoing.waits

    def fileno(self) -> int:
        """Return the descriptor for a selector; readable when `receive` has something."""
        return self._peer.fileno()

    def receive(self, timeout: float | None = None) -> list[SupervisorMessage]:
        """Return the supervisor's messages, oldest first; [] when none came in time.

        Raises:
            SupervisorEnded: the shutdown is complete.
            SupervisorGone: the supervisor was killed; its processes keep running.
            SupervisorError: the supervisor refused, or sent an unreadable message.
        """
        deadline = None if timeout is None else clocks.boot_time() + timeout
        while not self._received:
            if self._failure is not None:
                raise self._failure
            wait = None if deadline is None else max(0.0, deadline - clocks.boot_time())
            if not readable(self._peer, wait):
                return []
            self._read()
        received, self._received = self._received, []
        return received

    def close(self) -> None:
        """Close the connection; the instances keep running."""
        self._unforked.close()
        self._outgoing.close()

    def __enter__(self) -> Self:
        """Return this client; the block's end closes the connection."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the connection."""
        self.close()

    # --- sending ------------------------------------------------------------------------------

    def _launch(self, order: LaunchOrder) -> messages.Launch:
        base = self._base or {}
        environment = stamped_in(order.environment, launch_sent=clocks.wall_time_ns())
        changes: dict[str, str | None] = {
            name: value for name, value in environment.items() if base.get(name) != value
        }
        changes.update((name, None) for name in base if name not in environment)
        return messages.Launch(
            key_of(order.instance), order.argv, self._base_id, changes, order.working_directory,
            restart_rule(order.restart), stop_rule(order.stop), order.memo,
            fence_rule(order.fence), order.last_contact, order.limits, order.secrets,
            order.adoption, order.slots, order.files, order.contents,
        )  # fmt: skip

    def _choose_base(self, environment: Mapping[str, str]) -> None:
        """Send an environment as the base: others differ little, and are sent as changes."""
        self._base = dict(environment)
        self._base_id = os.urandom(8).hex()
        self._send(messages.encode_order(messages.Environment(self._base_id, self._base)))

    def _send(self, data: bytes) -> None:
        try:
            self._outgoing.send(data)
        except Overfull:
            most = f"{MOST_UNSENT >> 20} MiB"
            full = SupervisorGone(f"{self._name()} takes no orders, and {most} of them wait for it")
            self._fail(full)  # before the reader notices the end of the connection
            self._outgoing.drop()
            raise full from None
        except OSError as error:
            raise SupervisorGone(f"{self._name()} is gone: {reason_of(error)}") from None

    # --- receiving ----------------------------------------------------------------------------

    def _introduce(self, log: LogLimits, deadline: float) -> None:
        """Send `hello`, and take the welcome; raises `TimeoutError`."""
        self.send(messages.Hello(messages.PROTOCOL, os.getpid(), log))
        while not self.pid:
            if self._failure is not None:
                raise self._failure
            if not readable(self._peer, max(0.0, deadline - clocks.boot_time())):
                raise TimeoutError
            self._read()

    def _read(self) -> None:
        try:
            data = self._peer.recv(_CHUNK, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return
        except OSError as error:
            self._lose(f"{self._name()} is gone: {reason_of(error)}")
            return
        if not data:
            self._lose(f"{self._name()} is gone; its processes keep running")
        try:
            for line in self._lines.feed(data):
                self._take(json_lines.parse(line))
        except (json_lines.ProtocolError, KeyError, TypeError, ValueError) as error:
            self._fail(SupervisorError(f"{self._name()} cannot be understood: {error}"))

    def _lose(self, reason: str) -> None:
        """Record the end of the connection; after `ended` it means a complete shutdown."""
        if self._ending:
            self._fail(SupervisorEnded(f"{self._name()} has ended, and all its processes"))
        else:
            self._fail(SupervisorGone(reason))

    def _take(self, fields: Mapping[str, object]) -> None:
        kind = fields["tell"]
        if kind == "status":
            self._received.append(status_from(fields["status"]))
        elif kind == "amended":
            instance = InstanceId(*messages.read_key(fields["instance"]))
            refusal = messages.read_text(fields.get("refusal", ""))
            self._received.append(Amended(instance, amendment_from(fields), refusal))
        elif kind == "welcome":
            self._take_welcome(fields)
        elif kind == "refused":
            self._fail(SupervisorError(str(fields["message"])))
        elif kind == "ended":
            self._ending = True
        else:
            raise ValueError(f"it sent {kind!r}, which this version does not know")

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
        self.unenforced = messages.read_texts(fields.get("unenforced", _NOTHING_ENFORCED))
        self.reads_secrets = bool(fields.get("secrets", False))
        self.amends_limits = bool(fields.get("amends", False))
        self.adopts = bool(fields.get("adopts", False))
        self.holds_starts = bool(fields.get("holds", False))
        self.writes_files = bool(fields.get("contents", False))
        groups: Any = fields.get("groups", ())
        self.groups = tuple((version, top, tuple(names)) for version, top, names in groups)
        self.memos = {InstanceId(*messages.read_key(key)): str(memo) for key, memo in memos}

    def _fail(self, failure: SupervisorError) -> None:
        """Store the error that ends the connection; `receive` delivers earlier messages first."""
        if self._failure is None:
            self._failure = failure

    def _name(self) -> str:
        pid = f" (pid {self.pid})" if self.pid else ""
        return f"the supervisor{pid} of {self._state}"
