"""Writer of an active node's newest snapshot, for the next start of its process.

The author's cycle only saves the state, as for a shadow; a thread writes the file.
"""

from __future__ import annotations

import atexit
import threading
import zlib
from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from rclpy.serialization import serialize_message

from rosrm import clocks, threads
from rosrm.node.handoff.state_parts import StateError, StateTopic
from rosrm.node.managed_node import Mode, NodeEntities
from rosrm.node.steady_timer import steady_timer
from rosrm.snapshots.format import LARGEST, Block
from rosrm.snapshots.writer import SlotWriter
from rosrm.version import PROTOCOL_VERSION
from rosrm.wording import reason_of
from rosrm_msgs.msg import StateMark, StatePart

#: Share of a node's time for saving its state; `keep_every` may require a larger one.
_SHARE: Final = 0.02
#: Seconds for the last snapshot at the end, first for its lock, then for its writing.
_CLOSE_PATIENCE: Final = 5.0
#: Seconds until a snapshot that cannot be written is tried again, unless there is a newer one.
_RETRY: Final = 5.0
#: Seconds between two log lines about the same fault.
_LOGGED_EVERY: Final = 60.0


class SnapshotSaver:
    """Periodic saving between cycles, as often as `_SHARE` allows, at least each `keep_every` s.

    Args:
        entities: the node, whose identity names the directory.
        parts: parts of its state; those that the author names later are appended to this list.
        run: random number of this run of the node.
    """

    def __init__(self, entities: NodeEntities, parts: list[StateTopic], run: int) -> None:
        self._entities = entities
        self._parts = parts
        self._run = run
        self._every = entities.identity.keep_every
        self._next = 0.0
        self._kept = 0  # without a cycle there is nothing to keep: the constructor may have failed
        self._closed = False
        self._due: list[int] = []
        self._publishers: dict[str, int] = {}
        self._writer = _Writer(entities)
        # A state not saved right after its cycle is saved later, even if no cycle follows.
        self._late = steady_timer(
            entities.plain, max(self._every, 1e-3), self._keep_late, autostart=False
        )
        self._armed = False
        if entities.sequence:  # the state came from another instance, so this one has no file of it
            atexit.register(self.close)
            self._arm()

    def after_cycle(self) -> None:
        """Save the state after a cycle, or schedule a later save."""
        now = clocks.boot_time()
        if now >= self._next:
            self._keep(now)
        elif not self._armed:
            self._arm()

    def _arm(self) -> None:
        self._armed = True
        self._late.reset()

    def _keep_late(self) -> None:
        with self._entities.turn:
            self._armed = False
            self._late.cancel()
            if self._may_keep():
                self._keep(clocks.boot_time())

    def _may_keep(self) -> bool:
        """Return True if the state is new, and lies between two cycles of an active node."""
        entities = self._entities
        new = entities.sequence != self._kept
        return new and entities.mode is Mode.ACTIVE and not entities.in_cycle

    def _keep(self, now: float) -> None:
        if not self._next:  # not earlier: it would hold a node whose constructor raises for ever
            atexit.register(self.close)
        try:
            blocks = self._blocks()
        except StateError as error:
            self._next = now + self._every
            self._entities.node.get_logger().error(
                f"no snapshot was written: {error}", throttle_duration_sec=_LOGGED_EVERY
            )
            return
        self._kept = self._entities.sequence
        self._writer.put(self._kept, blocks)
        cost = clocks.boot_time() - now
        self._next = now + min(self._every, cost / _SHARE)

    def _blocks(self) -> list[Block]:
        for part in self._parts:
            part.refresh()
        states = [part.block() for part in self._parts]
        sizes = [len(state.data) for state in states]
        mark = bytes(serialize_message(self._mark(sizes)))
        blocks = [Block(mark, zlib.crc32(mark)), *states]
        size = sum(len(block.data) for block in blocks)
        if size > LARGEST - (1 << 20):
            raise StateError(f"it has {size} bytes; the maximum is {LARGEST}")
        return blocks

    def _mark(self, sizes: list[int]) -> StateMark:
        entities = self._entities
        # No digests: the file has checksums, and hashing takes time in each cycle.
        parts = [
            StatePart(topic=part.topic, type=part.type_name, size=size)
            for part, size in zip(self._parts, sizes, strict=True)
        ]
        return StateMark(
            protocol_version=PROTOCOL_VERSION, run=self._run, sequence=entities.sequence,
            last=False,
            parts=parts,
            inputs=entities.covered_inputs(self._publishers_of),
            timers_due=array("q", self._timers_due()),
        )  # fmt: skip

    def _publishers_of(self, one: Any) -> int:
        try:
            self._publishers[one.key] = one.subscription.get_publisher_count()
        except Exception:  # noqa: BLE001 - at shutdown ROS may be gone already
            self._publishers.setdefault(one.key, 1)
        return self._publishers[one.key]

    def _timers_due(self) -> list[int]:
        try:
            self._due = self._entities.timers_due()
        except Exception:  # noqa: BLE001 - at shutdown ROS may be gone already
            return self._due
        return self._due

    def close(self) -> None:
        """Store the last state at an orderly end."""
        if self._closed:
            return
        self._closed = True
        # The wait is limited, because another thread of the executor may be stuck in a callback.
        if self._entities.turn.acquire(timeout=_CLOSE_PATIENCE):
            try:
                if self._may_keep():
                    self._keep(clocks.boot_time())
            finally:
                self._entities.turn.release()
        self._writer.close()
        atexit.unregister(self.close)


class _Writer:
    """Thread that writes the newest snapshot; a newer one replaces one that still waits."""

    def __init__(self, entities: NodeEntities) -> None:
        self._entities = entities
        self._slots: SlotWriter | None = None
        self._waiting: tuple[int, Sequence[Block]] | None = None
        self._ending = False
        self._fault = ""
        self._changed = threading.Condition()
        self._thread: threads.Thread | None = None

    def put(self, sequence: int, blocks: Sequence[Block]) -> None:
        """Queue a snapshot for writing; return at once."""
        with self._changed:
            self._waiting = sequence, blocks
            self._changed.notify()
        if self._thread is not None:
            return
        try:  # not earlier, because writing would delay a successor's announcement
            self._thread = threads.start(self._work, "rosrm snapshots", again=True)
        except RuntimeError as fault:  # a limit of threads
            self._not_written(fault)

    def close(self) -> None:
        """Write the waiting snapshot, and end the thread."""
        if self._thread is None:
            return
        with self._changed:
            self._ending = True
            self._changed.notify()
        self._thread.join(_CLOSE_PATIENCE)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting is not None or self._ending)
                waiting = self._waiting
            if waiting is None:
                break
            try:
                if not self._write(*waiting):
                    break
            except OSError as error:
                self._not_written(error)
                with self._changed:
                    is_newest = self._waiting is waiting
                    if is_newest and self._ending:
                        break
                    if is_newest:
                        self._changed.wait(_RETRY)
                continue
            with self._changed:
                if self._waiting is waiting:
                    self._waiting = None
        if self._slots is not None:
            self._slots.close()

    def _write(self, sequence: int, blocks: Sequence[Block]) -> bool:
        """Write a snapshot; return False, to end the thread, if a newer instance writes there.

        Raises:
            OSError: the snapshot cannot be written.
        """
        identity = self._entities.identity
        if self._slots is None:
            self._slots = SlotWriter(Path(identity.keep), identity.process, identity.instance)
        if self._slots.write(sequence, blocks):
            self._written(sequence)
            return True
        self._warn(f"not saved any more: {identity.keep} is a newer instance's")
        return False

    def _written(self, sequence: int) -> None:
        if self._fault:
            self._fault = ""
            # This call needs its own line: rclpy binds one severity to a line, else it raises.
            self._entities.node.get_logger().info(
                f"its state is saved again, up to cycle {sequence}"
            )

    def _not_written(self, error: Exception) -> None:
        if self._fault != str(error):
            self._fault = str(error)
            self._warn(
                f"not saved: {reason_of(error)}, in {self._entities.identity.keep}. The node "
                f"continues, and writes it again later"
            )

    def _warn(self, message: str) -> None:
        self._entities.node.get_logger().warning(f"its state is {message}")
