"""Snapshots on this host: reported to the master, sent to other hosts, fetched for a start.

The slave's loop calls this module. File operations run in a thread of their own, which returns
their results to the loop. So a slow disk, or a snapshot of many megabytes, delays no beat.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import queue
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

from rosrm import clocks, threads
from rosrm.config.settings import KeepSettings
from rosrm.model.values import Assignment, InstanceId, SnapshotReport
from rosrm.ros.slave.replication import MOST, NotStored, ReplicationEndpoint
from rosrm.shortage import SHORTAGE
from rosrm.slave.replication.fetch import Fetch
from rosrm.slave.replication.store import SnapshotStore
from rosrm.snapshots.format import Head, TransferPart
from rosrm.snapshots.reader import snapshot_files
from rosrm.snapshots.writer import drop_snapshots
from rosrm.wording import reason_of

_log = logging.getLogger("rosrm.slave")

#: Seconds between two scans of the snapshots on this host.
_SCAN_EVERY: Final = 1.0
#: Seconds after which the report to the master is repeated without a change.
_REPORT_PERIOD: Final = 10.0
#: Seconds for the acknowledgement of one part. A slave that was just discovered may not be able to
#: answer yet.
_PART_TIMEOUT: Final = 1.0
#: Seconds after which a transfer to a host that refused a snapshot is retried.
_AGAIN: Final = 3.0
#: Seconds until a search on this host is repeated that an error of a lack has ended.
_SEARCH_AGAIN: Final = 1.0
#: Errors of a lack, which may end at any moment.
_OF_A_LACK: Final = SHORTAGE | {errno.ENOSPC, errno.EDQUOT}
#: Most parts from other hosts that wait for the thread.
_MOST_WAITING: Final = 64
#: Codes of failures of the network alone.
_TRANSIENT: Final = frozenset({"timeout", "order", "stale"})


#: Answer for a part that could not be written because of an unexpected error.
_FAILED: Final = NotStored("full", "the slave failed to store it; its log has the reason")


@dataclass(slots=True)
class _Shipment:
    """Replication of an instance's snapshots to other hosts.

    Attributes:
        sent: age of the newest snapshot that each host accepted.
        due: monotonic time of the next transfer to each host, seconds.
        refusals: code with which each host refused the last snapshot; "": "stale" for the first
            time.
    """

    instance: InstanceId
    hosts: tuple[str, ...]
    every: float
    sent: dict[str, tuple[int, int]] = field(default_factory=dict)
    due: dict[str, float] = field(default_factory=dict)
    refusals: dict[str, str] = field(default_factory=dict)


@dataclass(slots=True)
class _Transfer:
    """Transfer of one snapshot to one host.

    Attributes:
        content: of the snapshot; b"" until it was read.
        waits: True while the snapshot is being read, or an answer to a part is awaited.
    """

    shipment: _Shipment
    host: str
    head: Head | None = None
    content: bytes = b""
    digest: int = 0
    offset: int = 0
    waits: bool = True


class _Found(NamedTuple):
    """Newest snapshot on this host that a node can read.

    Attributes:
        head: its header; None: there is none.
        fault: why the replica on this host is not used; "": it is used, or there is none.
        may_pass: an error of a lack is the reason, such as too many open files.
    """

    head: Head | None
    fault: str
    may_pass: bool = False


class ReplicationService:
    """Snapshots and replicas of one host.

    Args:
        root: directory of all snapshots.
        post: schedules a call in the loop; may be called from any thread.
        publish: reports the snapshots to the master; returns False if there is no master.
    """

    def __init__(
        self, root: Path, host: str, settings: KeepSettings, endpoint: ReplicationEndpoint, *,
        post: Callable[[Callable[[], None]], None],
        publish: Callable[[Sequence[SnapshotReport]], bool],
    ) -> None:  # fmt: skip
        self._host = host
        self._settings = settings
        self._endpoint = endpoint
        self._post, self._publish = post, publish
        self._store = SnapshotStore(root, settings.max_bytes)
        self._jobs: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._shipments: dict[str, _Shipment] = {}
        self._transfers: dict[str, _Transfer] = {}
        #: Instances that wait for a snapshot; None: the local search is running.
        self._preparing: dict[InstanceId, Fetch | None] = {}
        #: Searches to repeat, with the time of each.
        self._repeated: list[tuple[float, Callable[[], None]]] = []
        self._parts_waiting = 0
        for path in self._store.drop_torn():
            _log.warning("%s: incomplete since a loss of power, deleted", path)
        self._snapshots = self._store.scan()
        self._reported: tuple[SnapshotReport, ...] | None = None
        self._reported_at = 0.0
        self._next_scan = 0.0
        self._is_scanning = False
        self._is_used = self._store.is_used()
        self._budget = float(settings.max_rate)
        self._budget_at = clocks.boot_time()
        threads.start(self._work, "snapshots", again=True)
        endpoint.serve(self)

    # --- the thread ----------------------------------------------------------------------

    def _work(self) -> None:
        while True:
            self._jobs.get()()

    def _in_thread(
        self, work: Callable[[], Any], then: Callable[[Any], None], otherwise: Any = None
    ) -> None:
        """Run `work` in the thread, then `then` in the loop with its result.

        If `work` raises, the exception is logged, and the result is `otherwise`.
        """

        def job() -> None:
            try:
                outcome = work()
            except Exception as error:  # noqa: BLE001 - the thread has to live on
                _log.info("a snapshot: %s: %s", type(error).__name__, error)
                outcome = otherwise
            self._post(partial(then, outcome))

        self._jobs.put(job)

    def leave_out(self, seconds: float) -> None:
        """Prolong all fetches by a suspend of this machine."""
        for fetch in self._preparing.values():
            if fetch is not None:
                fetch.leave_out(seconds)

    # --- requests of the master ----------------------------------------------------------

    def keep(self, instance: InstanceId, hosts: Sequence[str], every: float) -> None:
        """Replicate the snapshots of an instance to these hosts from now on."""
        wanted = tuple(name for name in hosts if name != self._host)
        known = self._shipments.get(instance.process)
        if known is not None and known.instance.number > instance.number:
            return
        new = _Shipment(instance, wanted, max(every, 0.1))
        if known is not None:
            new.sent, new.due, new.refusals = known.sent, known.due, known.refusals
        self._shipments[instance.process] = new

    def drop(self, instance: InstanceId, *, lives: bool) -> None:
        """Delete the snapshots of instances up to this one, unless one of them runs here."""
        if lives:
            return
        known = self._shipments.get(instance.process)
        if known is not None and known.instance.number <= instance.number:
            del self._shipments[instance.process]
        drop = partial(self._store.drop, instance.process, instance.number)
        self._in_thread(drop, lambda _: None)
        self._next_scan = 0.0

    def ended(self, instance: InstanceId) -> None:
        """Forget the key of an instance that has ended without a snapshot."""
        # Most hosts have no snapshots, and need no job of the thread.
        if self._is_used:
            drop = partial(self._store.keys.drop, instance.process, instance.number)
            self._in_thread(drop, lambda _: None)

    def report_again(self) -> None:
        """Report all snapshots to a master that has just registered this host."""
        self._reported = None
        self._report(clocks.boot_time())

    # --- the loop ------------------------------------------------------------------------

    def tick(self, now: float) -> None:
        """Continue all work that is due; called several times a second."""
        self._endpoint.expire(now)
        if now < self._next_scan and not (self._shipments or self._transfers or self._preparing):
            return
        rate = float(self._settings.max_rate)
        self._budget = min(rate, self._budget + rate * (now - self._budget_at))
        self._budget_at = now
        if now >= self._next_scan and not self._is_scanning:  # the disk may not answer
            self._next_scan, self._is_scanning = now + _SCAN_EVERY, True
            self._in_thread(partial(self._scan, now), self._scanned)
        for shipment in list(self._shipments.values()):
            self._begin_due(shipment, now)
        for transfer in list(self._transfers.values()):
            self._send_part(transfer, now)
        for fetch in list(self._preparing.values()):
            if fetch is not None:
                fetch.advance(now)
        due = [search for at, search in self._repeated if now >= at]
        self._repeated = [one for one in self._repeated if now < one[0]]
        for search in due:
            search()

    def states(self) -> tuple[SnapshotReport, ...]:
        """Return the snapshots on this host, as of the last scan."""
        return self._snapshots

    def _scan(self, now: float) -> tuple[SnapshotReport, ...]:
        if not self._is_used and not self._store.is_used():
            return ()
        self._is_used = True
        self._store.end_interrupted(now)
        return self._store.scan()

    def _scanned(self, states: tuple[SnapshotReport, ...] | None) -> None:
        self._is_scanning = False
        if states is not None:
            self._snapshots = states
            self._report(clocks.boot_time())

    def _report(self, now: float) -> None:
        quiet = not self._snapshots and not self._reported
        if self._snapshots == self._reported and (
            quiet or now - self._reported_at < _REPORT_PERIOD
        ):
            return
        if self._publish(self._snapshots):
            self._reported, self._reported_at = self._snapshots, now

    # --- to other hosts ------------------------------------------------------------------

    def _begin_due(self, shipment: _Shipment, now: float) -> None:
        process = shipment.instance.process
        if process in self._transfers:
            return
        # The host that waits longest comes first, so a host without an answer delays no other.
        for host in sorted(shipment.hosts, key=lambda name: shipment.due.get(name, 0.0)):
            is_due = now >= shipment.due.get(host, 0.0)
            if is_due and self._endpoint.finds_receiver(host, process, now):
                shipment.due[host] = now + shipment.every
                transfer = self._transfers[process] = _Transfer(shipment, host)
                sent = shipment.sent.get(host, (0, 0))
                read = partial(self._store.newer_than, process, sent)
                self._in_thread(read, partial(self._begin, transfer))
                return

    def _begin(self, transfer: _Transfer, found: tuple[Head, bytes, int] | None) -> None:
        shipment = transfer.shipment
        if found is not None and found[0].instance > shipment.instance.number:
            # A successor runs elsewhere, and this newer snapshot is a replica from its host.
            self._shipments.pop(shipment.instance.process, None)
            found = None
        if found is None:
            self._end(transfer)
            return
        transfer.head, transfer.content, transfer.digest = found
        transfer.waits = False
        self._send_part(transfer, clocks.boot_time())

    def _send_part(self, transfer: _Transfer, now: float) -> None:
        """Send the next part, as soon as the limit of the sending rate allows it."""
        head = transfer.head
        if transfer.waits or head is None or self._budget <= 0.0:
            return
        data = transfer.content[transfer.offset : transfer.offset + MOST]
        part = TransferPart(
            head.process, head.instance, head.sequence, transfer.offset, len(transfer.content),
            transfer.digest, data,
        )  # fmt: skip
        self._budget -= len(data)
        transfer.waits = True
        answered = partial(self._given, transfer, len(data))
        self._endpoint.give(transfer.host, part, now, _PART_TIMEOUT, answered)

    def _given(self, transfer: _Transfer, size: int, refusal: NotStored | None) -> None:
        shipment, head, host = transfer.shipment, transfer.head, transfer.host
        now = clocks.boot_time()
        if refusal is not None and head is not None:
            self._not_taken(shipment, host, head, now, refusal)
            self._end(transfer)
            return
        transfer.offset += size
        transfer.waits = False
        if head is not None and transfer.offset >= len(transfer.content):
            shipment.sent[host] = head.age
            shipment.refusals.pop(host, None)
            self._end(transfer)
        else:
            self._send_part(transfer, now)

    def _not_taken(
        self, shipment: _Shipment, host: str, head: Head, now: float, refusal: NotStored
    ) -> None:
        """Schedule another transfer, at once if only a message was lost."""
        if refusal.code == "newer":  # the acknowledgement of the last part may be lost
            shipment.sent[host] = head.age
            return
        if refusal.code in _TRANSIENT:
            shipment.due[host] = now
        else:
            shipment.due[host] = now + max(_AGAIN, shipment.every)
        if refusal.code == "stale" and host not in shipment.refusals:
            shipment.refusals[host] = (
                ""  # the next transfer has another ticket, so nothing is wrong
            )
        elif shipment.refusals.get(host) != refusal.code:
            shipment.refusals[host] = refusal.code
            instance, why = shipment.instance, refusal.message
            _log.info("%s does not keep the state of %s: %s", host, instance, why)

    def _end(self, transfer: _Transfer) -> None:
        process = transfer.shipment.instance.process
        if self._transfers.get(process) is transfer:
            del self._transfers[process]

    # --- from other hosts ----------------------------------------------------------------

    def take_part(self, part: TransferPart, answer: Callable[[NotStored | None], None]) -> None:
        """Store a part of a snapshot from another host."""

        def taken(refusal: NotStored | None) -> None:
            self._parts_waiting -= 1
            if part.is_last and refusal is None:
                self._next_scan = 0.0  # the master may need the new replica at once
            answer(refusal)

        if self._parts_waiting >= _MOST_WAITING:
            answer(NotStored("full", f"{_MOST_WAITING} parts wait for the disk"))
            return
        self._parts_waiting += 1
        self._in_thread(partial(self._store.take, part, bounded=True), taken, _FAILED)

    def read_part(
        self, process: str, age: tuple[int, int], offset: int, size: int,
        answer: Callable[[TransferPart | None], None],
    ) -> None:  # fmt: skip
        """Answer another host's request for a part of a snapshot."""
        self._in_thread(partial(self._store.read, process, age, offset, size), answer)

    # --- for a start ---------------------------------------------------------------------

    def prepare(self, assignment: Assignment, done: Callable[[Assignment], None]) -> bool:
        """Fetch the newest snapshot before an instance starts; return True if it may start now.

        Otherwise `done` is called when the snapshot has arrived, or does not arrive in time.
        """
        if not assignment.has_snapshots:
            return True
        self._preparing[assignment.instance] = None
        self._is_used = True
        self._search(assignment, done, clocks.boot_time() + self._settings.wait)
        return False

    def _search(
        self, assignment: Assignment, done: Callable[[Assignment], None], until: float
    ) -> None:
        """Search on this host; repeat until a time what an error of a lack ends."""
        instance = assignment.instance
        unkeyed = replace(assignment, state_key=b"")  # the key stays in the store

        def looked(found: _Found) -> None:
            now = clocks.boot_time()
            if found.may_pass and now < until and instance in self._preparing:
                again = partial(self._search, assignment, done, until)
                self._repeated.append((now + _SEARCH_AGAIN, again))
            else:
                self._looked(unkeyed, found, done)

        if instance in self._preparing:
            if assignment.state_key:  # before the search, so that one `save` stores all keys
                self._store.keys.put(instance.process, instance.number, assignment.state_key)
            self._in_thread(partial(self._look_for, assignment), looked, _Found(None, ""))

    def _look_for(self, assignment: Assignment) -> _Found:
        """Return the newest usable local snapshot, in the thread; delete unusable ones."""
        process, number = assignment.instance.process, assignment.instance.number
        self._store.make()  # the node creates its own directory below
        directory = self._store.directory(process)
        try:
            if not assignment.shadow and any(
                head.instance < assignment.snapshots_from for _, head in snapshot_files(directory)
            ):
                drop_snapshots(directory, assignment.snapshots_from - 1)
            if assignment.state_key:
                self._store.keys.save(process)
            else:
                self._store.keys.delete(process)
            fault = self._store.open_replica(process, number)
            return _Found(self._store.newest_readable(process), fault)
        except OSError as error:
            may_pass = error.errno in _OF_A_LACK
            return _Found(self._readable_now(process), reason_of(error), may_pass)

    def _readable_now(self, process: str) -> Head | None:
        """Return the newest snapshot that can be read in spite of an error."""
        with contextlib.suppress(OSError):
            return self._store.newest_readable(process)
        return None

    def _looked(
        self, assignment: Assignment, found: _Found, done: Callable[[Assignment], None]
    ) -> None:
        """Fetch a newer snapshot from another host, if there is one."""
        instance, hosts = assignment.instance, assignment.snapshot_hosts
        if found.fault:
            _log.info("the replica here is not used for %s: %s", instance, found.fault)
        if instance not in self._preparing:
            return
        # The master also names a host to which the replica was still on its way.
        is_here = hosts[:1] == (self._host,) and found.head is not None and not found.fault
        if assignment.shadow or not hosts or is_here:
            del self._preparing[instance]
            done(assignment)
            return

        def ended(message: str) -> None:
            if self.forget(instance):
                _log.info("%s", message)
                done(assignment)

        fetch = self._preparing[instance] = Fetch(
            assignment, tuple(name for name in hosts if name != self._host), self._endpoint,
            here=found.head, patience=self._settings.wait, take=self._take_fetched, ended=ended,
        )  # fmt: skip
        fetch.advance(clocks.boot_time())

    def _take_fetched(self, part: TransferPart, then: Callable[[NotStored | None], None]) -> None:
        self._in_thread(partial(self._store.take, part, bounded=False), then, _FAILED)

    def is_preparing(self, instance: InstanceId) -> bool:
        """Return True if the start of an instance waits for a snapshot."""
        return instance in self._preparing

    def forget(self, instance: InstanceId) -> bool:
        """Cancel the preparation of an instance's start; return False if there is none."""
        if instance not in self._preparing:
            return False
        fetch = self._preparing.pop(instance)
        if fetch is not None:
            fetch.cancel()
        return True
