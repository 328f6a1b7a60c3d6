"""Simulated host that takes checkpoint images, and a strategy that plans them like `criu`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rosrm.model.plan import Commit, Execute, Move, Plan, SetRestart, Start, Step, Stop
from rosrm.model.values import Assignment, InstanceState, RestartPolicy
from tests.unit.core.cluster import Cluster, StartFirstOrStopFirst
from tests.unit.core.machine import Machine

#: Time-out of each step, seconds.
PATIENCE = 5.0


class Freezer(StartFirstOrStopFirst):
    """Strategy that moves like `relaunch` and takes checkpoint images."""

    host_check = "can_freeze"

    def host_fault(self, source: Mapping[str, str], destination: Mapping[str, str]) -> str:
        return ""

    def checkpoint(self, move: Move) -> Plan:
        here, source, policy = move.source_host, move.source, move.spec.restart
        give_back = SetRestart(source, here, policy, PATIENCE)
        return Plan(
            (
                SetRestart(source, here, RestartPolicy("never"), PATIENCE, undo=give_back),
                self._execute("freeze", move, undo=self._execute("thaw", move)),
                Commit(image="drop"),
                self._execute("kill", move),
                Stop(source, here, PATIENCE),
            )
        )

    def restore(self, move: Move) -> Plan:
        here, one = move.destination_host, move.destination
        alias = move.source_node if move.source_node != move.spec.name else ""
        return Plan(
            (
                self._execute("take", move, undo=self._execute("put_back", move)),
                Start(one, here, PATIENCE, alias, restored=True),
                self._execute("await", move),
                Commit(),
                SetRestart(one, here, move.spec.restart, PATIENCE),
            )
        )

    def _execute(self, name: str, move: Move, undo: Step | None = None) -> Execute:
        arguments = {"source": move.source.number, "destination": move.destination.number}
        return Execute(name, move.source_host, arguments, PATIENCE, undo)


class Holding(Machine):
    """Simulated host that restores an instance only from an image prepared for it."""

    taken: dict[int, int]

    def _launch(self, assignment: Assignment, now: float) -> None:
        super()._launch(assignment, now)
        instance = assignment.instance
        if assignment.restored and instance in self.programs and instance.number not in self.taken:
            self._end(instance, InstanceState.FAILED, now, code=125)


class Shelf:
    """Simulated host with these executors and its checkpoint images.

    Attributes:
        images: numbers of the instances that have an image.
        taken: images that are being restored: number of the new instance -> number of the instance
            in the image.
        frozen: frozen instances.
        alive: restored instances that kept their memory.
        trouble: executor name -> reason why it fails.
        mute: executor names that do their work and then report a failure.
        passing: executor names that fail once.
        asked: names of the executors, in the order of the calls.
    """

    def __init__(self, name: str, **fields: Any) -> None:
        self.images: set[int] = set()
        self.taken: dict[int, int] = {}
        self.frozen: set[int] = set()
        self.alive: set[int] = set()
        self.trouble: dict[str, str] = {}
        self.mute: set[str] = set()
        self.passing = False
        self.asked: list[str] = []
        tasks = {
            "can_freeze": lambda _: {}, "freeze": self._freeze, "thaw": self._thaw,
            "kill": lambda _: {}, "take": self._take, "put_back": self._put_back,
            "await": self._await, "drop": self._drop,
        }  # fmt: skip
        self.machine = Holding(
            name, executors={one: self._task(one, task) for one, task in tasks.items()}, **fields
        )
        self.machine.taken = self.taken

    def _task(self, name: str, task: Any) -> Any:
        def execute(arguments: Mapping[str, Any]) -> Any:
            self.asked.append(name)
            trouble = self.trouble.get(name)
            if trouble is not None:
                if self.passing:
                    del self.trouble[name]
                raise RuntimeError(trouble)
            answer = task(arguments) or {}
            if name in self.mute:
                self.mute -= {name} if self.passing else set()
                raise RuntimeError("no answer")
            return answer

        return execute

    def _freeze(self, arguments: Mapping[str, Any]) -> None:
        number = arguments["source"]
        assert any(one.number == number for one in self.machine.programs), "it has ended"
        self.frozen.add(number)
        self.images.add(number)

    def _thaw(self, arguments: Mapping[str, Any]) -> None:
        self.frozen.discard(arguments["source"])
        self.images.discard(arguments["source"])

    def _take(self, arguments: Mapping[str, Any]) -> None:
        source, destination = arguments["source"], arguments["destination"]
        if self.taken.get(destination) == source:
            return
        if source not in self.images:
            raise RuntimeError("there is no image")
        self.images.remove(source)
        self.taken[destination] = source

    def _await(self, arguments: Mapping[str, Any]) -> None:
        destination = arguments["destination"]
        assert any(one.number == destination for one in self.machine.programs), "it has ended"
        self.taken.pop(destination, None)
        self.alive.add(destination)

    def _put_back(self, arguments: Mapping[str, Any]) -> Any:
        destination = arguments["destination"]
        if destination in self.alive:
            return {"active": True}
        for instance in list(self.machine.programs):
            if instance.number == destination:  # the shim of this instance ends with its failure
                self.machine.finish(instance.process, self.cluster.now, code=125)
        if destination in self.taken:
            self.images.add(self.taken.pop(destination))
        return {}

    def _drop(self, arguments: Mapping[str, Any]) -> None:
        self.images.difference_update(arguments["numbers"])

    def play(self, *others: Machine | str, **settings: Any) -> Cluster:
        """Return a cluster whose first host is this one."""
        self.cluster = Cluster(self.machine, *others, strategies={"freezer": Freezer()}, **settings)
        self.cluster.wait(0.5)
        return self.cluster
