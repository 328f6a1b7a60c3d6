"""Simulated hosts whose slaves have the executors of `criu`: dump, fetch, restore, join."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from rosrm.core.master import events as happened
from rosrm.core.master.commands import SendOrder
from rosrm.model.orders import RunExecutor
from rosrm.model.values import InstanceId, InstanceState
from rosrm_criu.engine.compatibility import FACTS
from rosrm_criu.options import CriuOptions
from rosrm_criu.plans import (
    AWAIT_RESTORED,
    CHECKPOINT,
    COPY_CHANGES,
    COPY_MEMORY,
    END,
    EXPECT_COPY,
    FETCH,
    FETCH_CHANGES,
    FETCH_COPY,
    GO_ON,
    HOST_CHECK,
    INTRODUCE,
    JOIN,
    MEASURE_MEMORY,
    REMOVE_COPY,
)
from rosrm_criu.strategy import Criu
from tests.unit.core.machine import Machine
from tests.unit.core.nodes import Node

_OF_THE_COPY = (
    MEASURE_MEMORY, EXPECT_COPY, COPY_MEMORY, FETCH_COPY, COPY_CHANGES, FETCH_CHANGES, REMOVE_COPY,
)  # fmt: skip
_ALIKE = {name: "yes" if name == "all_users" else "4.2" for name in FACTS}


def by_criu(seconds: float = 2.0) -> Criu:
    """Return the shipped strategy with this time-out for each part of a move."""
    names = ("start", "leave", "dump", "transfer", "restore", "join")
    return Criu(CriuOptions(**{f"{name}_timeout": seconds for name in names}))


class Everywhere:
    """Strategy like `criu`, for hosts whose capability needs no probe."""

    def __init__(self, seconds: float) -> None:
        self.propose = by_criu(seconds).propose


@dataclass
class Portable(Machine):
    """Simulated host that takes part in moves by `criu`.

    Attributes:
        asked: names of the executors, in the order of the calls.
        befalls: by executor name, a call that runs once, just before the executor's work.
        mute: executor names whose next answer is lost.
        slow: executor names whose answers stay in `answers` until a test delivers them.
        stand_still: dumped (frozen) instances, with the attempt number of their dump.
    """

    asked: list[str] = field(default_factory=list)
    befalls: dict[str, Callable[[], None]] = field(default_factory=dict)
    mute: set[str] = field(default_factory=set)
    slow: set[str] = field(default_factory=set)
    answers: list[happened.OrderAnswered] = field(default_factory=list)
    stand_still: dict[int, str] = field(default_factory=dict)
    _turned_back: set[str] = field(default_factory=set)
    _now: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.executors |= {
            HOST_CHECK: lambda _: _ALIKE, INTRODUCE: lambda _: {}, FETCH: lambda _: {},
            CHECKPOINT: self._checkpoint, GO_ON: self._go_on, END: self._end_source,
            AWAIT_RESTORED: self._await_restored, JOIN: self._join,
            **dict.fromkeys(_OF_THE_COPY, lambda _: {}),
        }  # fmt: skip

    def obey(self, sent: SendOrder, now: float) -> happened.OrderAnswered:
        """Carry out an order; a lost answer becomes a time-out."""
        self._now = now
        executor = sent.order.executor if isinstance(sent.order, RunExecutor) else ""
        self.asked += [executor] if executor else []
        self.befalls.pop(executor, lambda: None)()
        answer = super().obey(sent, now)
        if executor in self.slow:
            self.answers.append(answer)
            # answer to no order: none has arrived yet
            return happened.OrderAnswered(0, accepted=True)
        if self.connected and executor not in self.mute:
            return answer
        self.mute.discard(executor)
        return happened.OrderAnswered(sent.order_id, accepted=False, code="timeout")

    def lose_power(self, now: float) -> None:
        """End everything on the host without any report; another slave starts later."""
        self.connected = False
        self.programs.clear()
        self.ends.clear()
        self.stand_still.clear()
        self.restart_slave(now)

    def restart_slave(self, now: float) -> None:
        """Restart the slave; the list of abandoned attempts is lost with the former slave."""
        super().restart_slave(now)
        self._turned_back.clear()

    def _node(self, arguments: Mapping[str, Any], role: str) -> Node | None:
        program = self.programs.get(InstanceId(arguments["process"], arguments[role]))
        return None if program is None else program.node

    # --- the source ----------------------------------------------------------------------

    def _checkpoint(self, arguments: Mapping[str, Any]) -> Any:
        node = self._node(arguments, "source")
        if arguments["attempt"] in self._turned_back or node is None:
            raise RuntimeError("it was turned back since, or has ended")
        node.active = False
        self.stand_still[node.instance.number] = arguments["attempt"]
        return {"offer": "of an image"}

    def _go_on(self, arguments: Mapping[str, Any]) -> Any:
        self._turned_back.add(arguments["attempt"])
        node = self._node(arguments, "source")
        if node is None:
            return {"fault": "it has ended"}
        number = node.instance.number
        if self.stand_still.get(number) == arguments["attempt"]:
            del self.stand_still[number]
            node.wake()
        return {}

    def _end_source(self, arguments: Mapping[str, Any]) -> Any:
        node = self._node(arguments, "source")
        if node is not None:
            self._end(node.instance, InstanceState.FAILED, self._now, signal=9)
        return {}

    # --- the destination -----------------------------------------------------------------

    def _await_restored(self, arguments: Mapping[str, Any]) -> Any:
        if self._node(arguments, "destination") is None:
            raise RuntimeError("it has ended")
        return {}

    def _join(self, arguments: Mapping[str, Any]) -> Any:
        node = self._node(arguments, "destination")
        if node is None:
            return {"fault": "it has ended"}
        if node.instance.number not in self.stand_still:  # otherwise the instance runs again
            node.wake()
        return {}
