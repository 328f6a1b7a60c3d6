"""For authors of migration strategies: moves, plans, and the steps that plans are made of.

A strategy answers a `Move` with a `Plan`. Its steps are values; the master carries them out::

    def propose(self, move):
        stop_there = Stop(move.destination, move.destination_host, 10.0)
        return Plan((
            Start(move.destination, move.destination_host, 10.0, undo=stop_there),
            AwaitReady(move.destination, move.destination_host, 30.0),
            Commit(),
            Stop(move.source, move.source_host, move.spec.stop.timeout),
        ), overlap=45.0)
"""

from rosrm.extensions.options import options_of
from rosrm.model.plan import (
    AwaitReady,
    AwaitReleased,
    Commit,
    Configure,
    Execute,
    HandoffPhase,
    Move,
    Plan,
    SetRestart,
    Start,
    Step,
    Stop,
)
from rosrm.model.values import InstanceId, MigrationPolicy, ProcessSpec, RestartPolicy

__all__ = [
    "AwaitReady",
    "AwaitReleased",
    "Commit",
    "Configure",
    "Execute",
    "HandoffPhase",
    "InstanceId",
    "MigrationPolicy",
    "Move",
    "Plan",
    "ProcessSpec",
    "RestartPolicy",
    "SetRestart",
    "Start",
    "Step",
    "Stop",
    "options_of",
]
