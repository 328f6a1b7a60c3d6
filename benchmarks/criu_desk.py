"""Observer that migrates a counter to and fro, in the lab of `benchmarks.criu`.

    python -m benchmarks.criu_desk '{"strategy": "criu", "mb": 10, "hops": 4, "write": 0.01}' ...

For each argument it starts a process, migrates it `hops` times, and ends it; `options` are those
of the strategy, and `write` is the share of the memory that the process writes each second. It
prints one line of JSON for each hop: see `Hop`.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

from std_msgs.msg import Int64MultiArray

from benchmarks.handoff import Observer
from benchmarks.handoff_nodes import QOS
from rosrm.errors import Refused
from rosrm.model.ros_settings import RosSettings
from rosrm.model.values import MigrationPolicy, ProcessSpec, RestartPolicy
from rosrm.ros.master_connection import MasterClient

_ROOT: Final = Path(__file__).resolve().parents[1]
#: Hz, of the counters.
RATE: Final = 50.0
#: Seconds for anything on a busy machine; a migration of 500 MB takes some seconds.
_PATIENCE: Final = 180.0
#: Seconds between two migrations, at least.
_SETTLE: Final = 0.5
_NAME: Final = "portable_counter"
_NS: Final = 1e9


class ReceivedCount(NamedTuple):
    """One count as the observer received it.

    Attributes:
        at: when DDS received it, unix time in seconds.
        number: the count: 1, 2, 3, ...
        passes: how often the node had read all its memory; 0 for a node without memory to read.
        checksum: of the content found by the last complete read.
    """

    at: float
    number: int
    passes: int = 0
    checksum: int = 0


@dataclass(frozen=True)
class Hop:
    """One migration, as seen by the observer.

    Attributes:
        strategy, mb: of the process.
        end: "migrated", "stayed" or "refused".
        why: the reason where it was not "migrated".
        silence: seconds of the longest time without a count.
        seconds: of the whole migration, by the master's record.
        parts: of it, by executor, by the same record.
        repeated: counts that were received twice, or out of order.
        missed: counts that were not received.
        checksums: of its memory; more than one: it has changed.
        restarted: the successor counts from 1 again.
    """

    strategy: str
    mb: float
    end: str
    why: str = ""
    silence: float = 0.0
    seconds: float = 0.0
    parts: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    repeated: int = 0
    missed: int = 0
    checksums: tuple[int, ...] = ()
    restarted: bool = False


class CountReceiver(Observer):
    """Receiver of all counts; those of `handoff` come on another topic."""

    def __init__(self) -> None:
        self.received: list[ReceivedCount] = []
        super().__init__(None)
        self._node.create_subscription(Int64MultiArray, "count", self._take_count, QOS)

    def _take_count(self, message: Int64MultiArray, info: Any) -> None:
        self.received.append(ReceivedCount(info["received_timestamp"] / _NS, *message.data))

    def _take(self, message: Int64MultiArray, info: Any) -> None:
        self.received.append(ReceivedCount(info["received_timestamp"] / _NS, message.data[1]))

    def wait_for_counts(self, counts: int, passes: int = 0) -> None:
        """Wait for so many more counts, and for so many complete reads of the memory."""
        begin, deadline = len(self.received), time.monotonic() + _PATIENCE
        while not self._has(begin, counts, passes):
            if time.monotonic() > deadline:
                raise TimeoutError(f"{counts} more counts were not received within {_PATIENCE:g} s")
            time.sleep(0.01)

    def _has(self, begin: int, counts: int, passes: int) -> bool:
        new = self.received[begin:]
        return len(new) >= counts and new[-1].passes - new[0].passes >= passes


class MigrationDriver:
    """Driver of the migrations, one process after the other."""

    def __init__(self, receiver: CountReceiver, client: MasterClient) -> None:
        self._receiver, self._client = receiver, client

    def play(
        self, strategy: str, mb: float, hops: int, options: Mapping[str, Any], write: float
    ) -> None:
        """Start a counter, migrate it to and fro, and end it."""
        self._client.submit([_spec(strategy, mb, options, write)])
        self._wait("running")
        passes = 2 if strategy == "criu" else 0  # the second one began after the migration
        self._receiver.wait_for_counts(int(RATE * _SETTLE), passes)
        for _ in range(hops):
            hop = self._hop(strategy, mb, passes)
            print(json.dumps(asdict(hop)), flush=True)
        self._client.cancel([_NAME])
        self._wait("cancelled", "finished", "failed")
        self._receiver.received.clear()

    def _hop(self, strategy: str, mb: float, passes: int) -> Hop:
        self._wait("running")
        before = self._client.list().last_sequence
        del self._receiver.received[:-2]  # the last ones before the migration
        if refusal := self._ask():
            return Hop(strategy, mb, "refused", refusal)
        end = self._end_after(before)
        self._receiver.wait_for_counts(int(RATE * _SETTLE), passes)
        received = list(self._receiver.received)
        numbers = [one.number for one in received]
        steps = [after - one for one, after in pairwise(numbers)]
        return Hop(
            strategy, mb, end.kind, "" if end.kind == "migrated" else end.message,
            silence=max(after.at - one.at for one, after in pairwise(received)),
            seconds=end.facts["seconds"], parts=end.facts.get("parts", {}),
            repeated=sum(step < 1 for step in steps),
            missed=max(numbers) - min(numbers) + 1 - len(set(numbers)),
            checksums=tuple({one.checksum for one in received if one.passes}),
            restarted=min(numbers) < numbers[0],
        )  # fmt: skip

    def _ask(self) -> str:
        """Request a migration; return the reason where it is refused, "" where it begins.

        Retries while the hosts' capabilities are not known yet.
        """
        deadline = time.monotonic() + _PATIENCE
        while True:
            try:
                self._client.migrate(_NAME)
            except Refused as refusal:
                if "not known yet" not in str(refusal) or time.monotonic() > deadline:
                    return str(refusal)
                self._client.spin(0.1)
            else:
                return ""

    def _end_after(self, before: int) -> Any:
        """Wait for the end of a migration; return its event."""
        deadline = time.monotonic() + _PATIENCE
        while time.monotonic() < deadline:
            for event in self._client.list(events=True, process=_NAME, after=before).events:
                if event.kind in ("migrated", "stayed"):
                    return event
            self._client.spin(0.02)
        raise TimeoutError(f"the migration did not end within {_PATIENCE:g} s")

    def _wait(self, *states: str) -> None:
        deadline = time.monotonic() + _PATIENCE
        while True:
            rows = [one for one in self._client.list(processes=True).processes if one.name == _NAME]
            if any(row.state in states for row in rows):
                return
            if time.monotonic() > deadline:
                raise TimeoutError(f"{_NAME} was not {' or '.join(states)} within {_PATIENCE:g} s")
            self._client.spin(0.05)


def _spec(strategy: str, mb: float, options: Mapping[str, Any], write: float) -> ProcessSpec:
    module, arguments = "rosrm_examples.portable_counter", f"--mb {mb:g} --period {1 / RATE:g}"
    if write:
        arguments += f" --write {write:g}"
    if strategy == "handoff":
        module, arguments = "benchmarks.handoff_nodes", f"count --rate {RATE:g}"
    return ProcessSpec(
        _NAME, module=module, arguments=tuple(arguments.split()), ros=True,
        environment={"PYTHONPATH": str(_ROOT)}, needs={"memory": 100e6 + 2e6 * mb},
        migration=MigrationPolicy(strategy, options=options),
        restart=RestartPolicy("on-failure", delay=0.5),
    )  # fmt: skip


def main() -> None:
    """Carry out the arguments, one after the other."""
    with (
        contextlib.closing(CountReceiver()) as receiver,
        MasterClient.connect(RosSettings(), name="criu desk", timeout=_PATIENCE) as client,
    ):
        driver = MigrationDriver(receiver, client)
        for asked in map(json.loads, sys.argv[1:]):
            driver.play(
                asked["strategy"], asked["mb"], asked["hops"], asked.get("options", {}),
                asked.get("write", 0.0),
            )  # fmt: skip


if __name__ == "__main__":
    main()
