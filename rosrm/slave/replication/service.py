"""Kept states of this host: reported to the master, shipped to other hosts, fetched for a start.

The loop calls it; what touches files runs in a thread of its own, and what comes of it is given
back to the loop. So a slow disk, or a state of many megabytes, keeps no beat from going out.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from rosrm import snapshots
from rosrm.config.settings import KeepSettings
from rosrm.model.values import Assignment, InstanceId, KeptState
from rosrm.ros.slave.replication import MOST, KeptEndpoint
from rosrm.slave.replication.fetch import Fetch
from rosrm.slave.replication.store import KeptStore
from rosrm.snapshots import Head, Part

#: Seconds between two looks at what is kept here.
_SCAN_EVERY: Final = 1.0
#: Seconds after which the master is told again, though nothing has changed.
_SAY_EVERY: Final = 10.0
#: Seconds for one part to be taken. A slave that was just found may not be able to answer yet.
_PART_TIMEOUT: Final = 1.0
#: Seconds after which a host that refuses a state is tried again.
_AGAIN: Final = 3.0
#: Why a part was not taken, where nothing but the wire is to blame.
_LOST_WORDS: Final = frozenset({"timeout", "order"})


#: What is answered where a part could not be taken for a reason that nobody thought of.
_FAILED: Final = ("full", "the slave failed to store it; its log has the reason")


@dataclass(slots=True)
class _Shipment:
    """Where the state of an instance goes.

    Attributes:
        sent: newest state that a host has taken.
        due: when a host gets the next one.
        said: why a host did not take the last one.
    """

    instance: InstanceId
    hosts: tuple[str, ...]
    every: float
    sent: dict[str, tuple[int, int]] = field(default_factory=dict)
    due: dict[str, float] = field(default_factory=dict)
    said: dict[str, str] = field(default_factory=dict)


@dataclass(slots=True)
class _Transfer:
    """One state on its way to one host.

    Attributes:
        content: None until it was read.
        waits: the answer to a part is awaited.
    """

    shipment: _Shipment
    host: str
    head: Head | None = None
    content: bytes = b""
    digest: int = 0
    offset: int = 0
    waits: bool = True


class Keeping:
    """The kept states of one host.

    Args:
        root: directory of all of them.
        host: name of this host.
        settings: bounds.
        endpoint: speaks with other slaves.
        post: has something called in the loop; may be called from any thread.
        say: tells the user.
        publish: tells the master what is kept here; False: there is none.
    """

    def __init__(
        self, root: Path, host: str, settings: KeepSettings, endpoint: KeptEndpoint, *,
        post: Callable[[Callable[[], None]], None], say: Callable[[str], None],
        publish: Callable[[Sequence[KeptState]], bool],
    ) -> None:  # fmt: skip
        self._host = host
        self._settings = settings
        self._endpoint = endpoint
        self._post, self._say, self._publish = post, say, publish
        self._store = KeptStore(root, settings.max_bytes)
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._shipments: dict[str, _Shipment] = {}
        self._transfers: dict[str, _Transfer] = {}
        #: Instances that wait for a state; None: it is being looked for here.
        self._preparing: dict[InstanceId, Fetch | None] = {}
        self._kept = self._store.scan()
        self._told: tuple[KeptState, ...] | None = None
        self._told_at = 0.0
        self._next_scan = 0.0
        self._budget = float(settings.max_rate)
        self._budget_at = time.monotonic()
        threading.Thread(target=self._work, name="kept states", daemon=True).start()
        endpoint.serve(self)

    # --- the thread ----------------------------------------------------------------------

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()

    def _in_thread(
        self, work: Callable[[], Any], then: Callable[[Any], None], otherwise: Any = None
    ) -> None:
        """Have something done by the thread.

        Args:
            work: done there.
            then: called in the loop with what it returned.
            otherwise: what `then` is called with if the work raised; that is said.
        """

        def job() -> None:
            try:
                outcome = work()
            except Exception as error:  # noqa: BLE001 - the thread has to live on
                self._post(partial(self._say, f"a snapshot: {type(error).__name__}: {error}"))
                outcome = otherwise
            self._post(partial(then, outcome))

        self._jobs.put(job)

    # --- the master's word ---------------------------------------------------------------

    def keep(self, instance: InstanceId, hosts: Sequence[str], every: float) -> None:
        """Ship the state of an instance to these hosts from now on."""
        wanted = tuple(name for name in hosts if name != self._host)
        known = self._shipments.get(instance.process)
        if known is not None and known.instance.number > instance.number:
            return
        new = _Shipment(instance, wanted, max(every, 0.1))
        if known is not None:
            new.sent, new.due, new.said = known.sent, known.due, known.said
        self._shipments[instance.process] = new

    def drop(self, instance: InstanceId, *, lives: bool) -> None:
        """Delete the states of instances up to this one, unless one of them lives here."""
        if lives:
            return
        known = self._shipments.get(instance.process)
        if known is not None and known.instance.number <= instance.number:
            del self._shipments[instance.process]
        drop = partial(self._store.drop, instance.process, instance.number)
        self._in_thread(drop, lambda _: None)
        self._next_scan = 0.0

    def say_again(self) -> None:
        """A master has taken this host in: it knows nothing yet."""
        self._told = None
        self._tell(time.monotonic())

    # --- the loop ------------------------------------------------------------------------

    def tick(self, now: float) -> None:
        """Do what is due; called some times a second."""
        self._endpoint.expire(now)
        rate = float(self._settings.max_rate)
        self._budget = min(rate, self._budget + rate * (now - self._budget_at))
        self._budget_at = now
        if now >= self._next_scan:
            self._next_scan = now + _SCAN_EVERY
            if self._kept or self._store.is_used():
                self._in_thread(self._store.scan, self._scanned)
        for shipment in list(self._shipments.values()):
            self._begin_due(shipment, now)
        for transfer in list(self._transfers.values()):
            self._go_on(transfer, now)
        for fetch in list(self._preparing.values()):
            if fetch is not None:
                fetch.go_on(now)

    def states(self) -> tuple[KeptState, ...]:
        """What is kept here, as of the newest look."""
        return self._kept

    def _scanned(self, states: tuple[KeptState, ...] | None) -> None:
        if states is not None:
            self._kept = states
            self._tell(time.monotonic())

    def _tell(self, now: float) -> None:
        quiet = not self._kept and not self._told
        if self._kept == self._told and (quiet or now - self._told_at < _SAY_EVERY):
            return
        if self._publish(self._kept):
            self._told, self._told_at = self._kept, now

    # --- to other hosts ------------------------------------------------------------------

    def _begin_due(self, shipment: _Shipment, now: float) -> None:
        process = shipment.instance.process
        if process in self._transfers:
            return
        # Who has waited longest goes first: one that does not answer holds up nobody.
        for host in sorted(shipment.hosts, key=lambda name: shipment.due.get(name, 0.0)):
            if now >= shipment.due.get(host, 0.0) and self._endpoint.finds_keeper(host, now):
                shipment.due[host] = now + shipment.every
                transfer = self._transfers[process] = _Transfer(shipment, host)
                sent = shipment.sent.get(host, (0, 0))
                read = partial(self._store.newer_than, process, sent)
                self._in_thread(read, partial(self._begin, transfer))
                return

    def _begin(self, transfer: _Transfer, found: tuple[Head, bytes, int] | None) -> None:
        shipment = transfer.shipment
        if found is not None and found[0].instance > shipment.instance.number:
            # Its successor runs elsewhere, and what came here came from there.
            self._shipments.pop(shipment.instance.process, None)
            found = None
        if found is None:
            self._end(transfer)
            return
        transfer.head, transfer.content, transfer.digest = found
        transfer.waits = False
        self._go_on(transfer, time.monotonic())

    def _go_on(self, transfer: _Transfer, now: float) -> None:
        """Give the next part, as soon as the bounds of this host's network allow it."""
        head = transfer.head
        if transfer.waits or head is None or self._budget <= 0.0:
            return
        data = transfer.content[transfer.offset : transfer.offset + MOST]
        part = Part(
            head.process, head.instance, head.sequence, transfer.offset, len(transfer.content),
            transfer.digest, data,
        )  # fmt: skip
        self._budget -= len(data)
        transfer.waits = True
        answered = partial(self._given, transfer, len(data))
        self._endpoint.give(transfer.host, part, now, _PART_TIMEOUT, answered)

    def _given(self, transfer: _Transfer, size: int, code: str, message: str) -> None:
        shipment, head, host = transfer.shipment, transfer.head, transfer.host
        now = time.monotonic()
        if code and head is not None:
            self._not_taken(shipment, host, head, now, code, message)
            self._end(transfer)
            return
        transfer.offset += size
        transfer.waits = False
        if head is not None and transfer.offset >= len(transfer.content):
            shipment.sent[host] = head.age
            shipment.said.pop(host, None)
            self._end(transfer)
        else:
            self._go_on(transfer, now)

    def _not_taken(
        self, shipment: _Shipment, host: str, head: Head, now: float, code: str, message: str
    ) -> None:
        """Give it again, at once where only a word was lost."""
        if code == "newer":  # the answer to the last part was lost, perhaps
            shipment.sent[host] = head.age
            return
        if code in _LOST_WORDS:
            shipment.due[host] = now
        else:
            shipment.due[host] = now + max(_AGAIN, shipment.every)
        if shipment.said.get(host) != code:
            shipment.said[host] = code
            self._say(f"{host} does not keep the state of {shipment.instance}: {message}")

    def _end(self, transfer: _Transfer) -> None:
        process = transfer.shipment.instance.process
        if self._transfers.get(process) is transfer:
            del self._transfers[process]

    # --- from other hosts ----------------------------------------------------------------

    def take_part(self, part: Part, answer: Callable[[str, str], None]) -> None:
        """A part of a state came from another host."""

        def taken(outcome: tuple[str, str]) -> None:
            if part.is_last and not outcome[0]:
                self._next_scan = 0.0  # the master may need it in the next moment
            answer(*outcome)

        self._in_thread(partial(self._store.take, part, bounded=True), taken, _FAILED)

    def read_part(
        self, process: str, age: tuple[int, int], offset: int, size: int,
        answer: Callable[[Part | None], None],
    ) -> None:  # fmt: skip
        """Another host wants a part of a state."""
        read = partial(self._store.read, process, age, offset, size, time.monotonic())
        self._in_thread(read, answer)

    # --- for a start ---------------------------------------------------------------------

    def prepare(self, assignment: Assignment, done: Callable[[Assignment], None]) -> bool:
        """See to it that the newest state is here before an instance starts.

        Returns:
            True: it may start now; else `done` is called when the state is here, or does not come
            in time.
        """
        if not assignment.has_snapshots:
            return True
        self._preparing[assignment.instance] = None
        self._in_thread(
            partial(self._look_for, assignment),
            lambda here: self._looked(assignment, here, done),
        )
        return False

    def _look_for(self, assignment: Assignment) -> Head | None:
        """Runs in the thread: the newest state that is here and of use."""
        self._store.make()  # its node makes its own directory below it
        directory = self._store.directory(assignment.spec.name)
        if not assignment.shadow and any(
            head.instance < assignment.kept_from for _, head in snapshots.files(directory)
        ):
            snapshots.drop(directory, assignment.kept_from - 1)
        return snapshots.newest_head(directory)

    def _looked(
        self, assignment: Assignment, here: Head | None, done: Callable[[Assignment], None]
    ) -> None:
        """Fetch what another host has newer, if anything."""
        instance, hosts = assignment.instance, assignment.kept_on
        if instance not in self._preparing:
            return
        if assignment.shadow or not hosts or hosts[0] == self._host:
            del self._preparing[instance]
            done(assignment)
            return

        def ended(message: str) -> None:
            if self.forget(instance):
                self._say(message)
                done(assignment)

        fetch = self._preparing[instance] = Fetch(
            assignment, tuple(name for name in hosts if name != self._host), self._endpoint,
            here=here, take=self._take_fetched, ended=ended,
        )  # fmt: skip
        fetch.go_on(time.monotonic())

    def _take_fetched(self, part: Part, then: Callable[[tuple[str, str]], None]) -> None:
        self._in_thread(partial(self._store.take, part, bounded=False), then, _FAILED)

    def is_preparing(self, instance: InstanceId) -> bool:
        """Its start waits for a state."""
        return instance in self._preparing

    def forget(self, instance: InstanceId) -> bool:
        """It is not to start any more; False: nothing was prepared for it."""
        if instance not in self._preparing:
            return False
        del self._preparing[instance]
        return True
