"""Restore of a process's newest snapshot by a new node, before its first cycle."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from rosrm import clocks
from rosrm.node.handoff.state_parts import StateError, StateTopic, differing_part, size_fault
from rosrm.node.identity import NodeIdentity
from rosrm.node.managed_node import NodeEntities
from rosrm.node.snapshots.marks import decoded_mark
from rosrm.node.steady_timer import steady_timer
from rosrm.snapshots.format import Listing
from rosrm.snapshots.reader import newest
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import StateMark

#: Seconds for the author's constructor to name all parts, if it spins first; check interval.
_PATIENCE: Final = 10.0
_LOOK: Final = 0.02
#: Seconds in which the error of a failed restore must end the process, and between two such errors.
_END_PATIENCE: Final = 10.0
_RAISED_AGAIN: Final = 1.0
#: Oldest protocol version whose snapshots can be read.
_OLDEST_READ: Final = 5
_REMEDY: Final = (
    "The node does not start, so that the snapshot is not overwritten. To start without it, cancel "
    "the process and submit it again"
)


def newest_snapshot(identity: NodeIdentity) -> tuple[Listing | None, list[str]]:
    """Return a process's newest snapshot, None without one, and faults of damaged files."""
    if identity.shadow or not identity.keep:
        return None, []
    return newest(Path(identity.keep), up_to=identity.instance)


class SnapshotRestore:
    """Restore of a snapshot in the executor's first round; until then the node acts as a shadow.

    By then the author's constructor has returned (or has named all parts), and no callback of the
    author has run.

    Args:
        entities: the node, at rest.
        parts: parts of its state; those that the author names later are appended to this list.
        snapshot: the snapshot.
        done: called when the node is active.
    """

    def __init__(
        self, entities: NodeEntities, parts: Sequence[StateTopic], snapshot: Listing,
        done: Callable[[], None],
    ) -> None:  # fmt: skip
        self._entities = entities
        self._parts = parts
        self._snapshot = snapshot
        self._done = done
        self._give_up = clocks.boot_time() + _PATIENCE
        self._fault = ""
        self._timer: Any = None
        self._call_in(0.0, self._look)

    def _call_in(self, seconds: float, call: Callable[[], None]) -> None:
        if self._timer is not None:
            self._entities.plain.destroy_timer(self._timer)
        self._timer = steady_timer(self._entities.plain, seconds, call)

    def _look(self) -> None:
        with self._entities.turn:
            if self._is_incomplete() and clocks.boot_time() < self._give_up:
                self._call_in(_LOOK, self._look)
                return
            try:
                self.restore()
            except StateError:
                self._give_up = clocks.boot_time() + _END_PATIENCE
                self._call_in(_RAISED_AGAIN, self._end_process)
                raise

    def restore(self) -> None:
        """Restore the snapshot now, because the author's constructor has returned.

        Raises:
            StateError: the snapshot cannot be restored, and the node must not start.
        """
        try:
            mark = self._restored()
        except StateError as fault:
            self._fault = f"the snapshot {self._snapshot.path} cannot be restored: {fault}"
            self._entities.node.get_logger().error(f"{self._fault}. {_REMEDY}")
            raise StateError(self._fault) from fault
        self._entities.plain.destroy_timer(self._timer)
        self._start(mark)

    def _end_process(self) -> None:
        """End a process that continues after the error: it would look healthy, and do nothing.

        An executor of several threads reports the error of a callback only after another one.
        """
        if clocks.boot_time() >= self._give_up:  # the author catches the errors
            os._exit(1)
        raise StateError(self._fault)

    def _is_incomplete(self) -> bool:
        """Return True if the author's constructor spins before it has named all parts."""
        return len(self._parts) < len(self._snapshot.blocks) - 1

    def _restored(self) -> StateMark:
        try:
            mark = decoded_mark(self._snapshot.blocks[0])
        except Exception as error:
            raise StateError(f"its mark cannot be read: {error}") from error
        fault = self._fault_of(mark)
        if fault:
            raise StateError(fault)
        topics = [part.topic for part in mark.parts]
        data = dict(zip(topics, self._snapshot.blocks[1:], strict=True))
        for part in self._parts:
            part.restore_changed(data[part.topic])
        return mark

    def _fault_of(self, mark: StateMark) -> str:
        if not _OLDEST_READ <= mark.protocol_version <= PROTOCOL_VERSION:
            return (
                f"it is of protocol version {mark.protocol_version}, and this node speaks "
                f"{PROTOCOL_VERSION}"
            )
        fault = size_fault(mark)
        if fault:
            return fault
        if len(mark.parts) != len(self._snapshot.blocks) - 1:
            return (
                f"it has {len(self._snapshot.blocks) - 1} parts, but its mark lists "
                f"{len(mark.parts)}"
            )
        differing = differing_part(self._parts, mark)
        if differing is None:
            return ""
        return (
            f"its part on {differing.topic} is {differing.theirs}, and this program's "
            f"{differing.ours}: it is of another version of the program"
        )

    def _start(self, mark: StateMark) -> None:
        entities = self._entities
        entities.sequence = int(mark.sequence)
        entities.cover(mark.inputs)
        entities.inherit(mark.inputs)
        try:
            entities.become_active(mark.timers_due, clocks.boot_time(), self._announce)
        finally:
            self._done()

    def _announce(self) -> None:
        head = self._snapshot.head
        self._entities.node.get_logger().info(
            f"continues from the snapshot of {head.process}#{head.instance}, cycle {head.sequence}"
        )
