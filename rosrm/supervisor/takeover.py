"""Take-over by a new supervisor of the instances that an earlier one of the same host recorded.

The supervisor identifies a process by its pid and start time. It starts no instance that may run
or may have run already. An instance whose end no supervisor saw has an unknown exit code.

The clocks of fences continue from the recorded last contact with the master, so killing the
supervisor postpones no fence. After a reboot the length of the outage is unknown, and a successor
may run elsewhere. So an instance with a fence is fenced. One without has failed with its machine,
and its restart policy decides.

A loss of power takes the newest lines of the record. So what the record of an earlier boot says
about an instance that had not ended is uncertain: one that is held or starting there may have run,
and may have finished. It has an unknown end, too, and only a policy to restart starts it. If its
node has snapshots, those of this host may be older than a replica on another one. So such an
instance is withdrawn instead of restarted: the master queues it again, with the newest snapshot.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from typing import Final

from rosrm import clocks
from rosrm.core.supervisor.events import (
    Event,
    Exited,
    FencePassed,
    Resumed,
    SessionEnded,
    Spawned,
    SpawnFailed,
    StopOrdered,
)
from rosrm.core.supervisor.instance import (
    BACKOFF,
    HELD,
    RUNNING,
    STARTING,
    STOPPING,
    THEN_END,
    THEN_POLICY,
    THEN_RESTART,
    UNKNOWN_EXIT,
    Instance,
)
from rosrm.core.supervisor.reducer import SupervisorState
from rosrm.core.supervisor.rules import Key
from rosrm.supervisor import instance_record, lease_file, procfs
from rosrm.supervisor.instance_record import Recorded
from rosrm.supervisor.process_tree import ProcessTrees, mark
from rosrm.supervisor.procfs import KEEP, Stat

_RESTARTED: Final = "its machine was restarted"


def restore(state: str, core: SupervisorState, trees: ProcessTrees) -> Recorded:
    """Read the record into the core, and take over the leaders that still run."""
    recorded = instance_record.read(state)
    for process, number in recorded.dead.items():
        core.dead.put(process, number)
    newest = lease_file.read(state)
    for instance in recorded.instances.values():
        if not recorded.same_boot:
            _restart_clock(instance, clocks.boot_time())
            _doubt(instance, has_snapshots=_has_snapshots(recorded, instance.key))
        alive = instance.fence is not None and instance.fence.alive
        instance.heard = max(instance.heard, newest.at, newest.alive if alive else -inf)
        core.restore(instance)
        leader = procfs.read_stat(instance.pid) if instance.pid and recorded.same_boot else None
        birth = recorded.births[instance.key]
        if leader is not None and leader.alive and procfs.was_born(leader, birth):
            trees.take_over(instance.key, leader)
    return recorded


def _restart_clock(instance: Instance, now: float) -> None:
    """Restart the clock of an instance recorded in an earlier boot; its deadlines are due now."""
    instance.recent.clear()  # times of the former boot may lie ahead, and would count for hours
    instance.begun = None
    if instance.deadline is not None:
        instance.deadline = now
    if instance.fence is not None:
        instance.heard = now - instance.fence.after
    if instance.kill_by is not None:
        instance.kill_by = now


def _has_snapshots(recorded: Recorded, key: Key) -> bool:
    launch = recorded.launches.get(key)
    if launch is None:
        return False
    base = recorded.environments.get(launch.environment, {})
    return bool(launch.changes.get(KEEP, base.get(KEEP)))


def _doubt(instance: Instance, *, has_snapshots: bool) -> None:
    """Let an instance recorded in an earlier boot be one that may have run to its end."""
    if instance.pid:
        instance.fault = _RESTARTED
    if instance.phase in (HELD, STARTING):
        instance.phase = STARTING  # never held: a free slot would start it
        instance.exit_code = UNKNOWN_EXIT
    if has_snapshots and not instance.ended and instance.then != THEN_END:
        instance.withdrawn = True
    if instance.then == THEN_RESTART:  # the ordered run may have begun
        instance.then = THEN_POLICY


def what_happened(
    recorded: Recorded, state: str, core: SupervisorState, trees: ProcessTrees
) -> Iterator[Event]:
    """Yield the changes of each instance while no supervisor ran."""
    waiting = [
        instance
        for instance in core.instances.values()
        if not (instance.ended or instance.phase == HELD or trees.birth(instance.key))
    ]
    marked = procfs.find_marked(state) if waiting else {}
    for instance in waiting:
        found = trees.in_group(instance.key)
        left = marked.get(mark(instance.key), []) if found is None else found
        if instance.phase == STARTING and not recorded.same_boot:
            if instance.fence is not None:
                yield FencePassed(instance.key)
            unknown = f"{_RESTARTED}: whether it had run is not known"
            yield SpawnFailed(instance.key, unknown, transient=True)
        elif instance.phase == STARTING:
            yield _start_of(instance, left, recorded, trees)
        elif instance.phase == BACKOFF and instance.withdrawn:
            yield StopOrdered(instance.key)
        elif instance.phase in (RUNNING, STOPPING):
            yield from _end_of(instance, left, trees)


def _start_of(
    instance: Instance, found: list[Stat], recorded: Recorded, trees: ProcessTrees
) -> Event:
    """Return the outcome of a start that was ordered but has no recorded outcome."""
    leaders = [stat for stat in found if stat.pid == stat.session]
    if instance.key not in recorded.spawning:
        return Resumed(instance.key)
    if leaders and trees.take_over(instance.key, leaders[0]):
        return Spawned(instance.key, leaders[0].pid)
    trees.kill(found)
    lost = "the supervisor was killed while it started this: how that went is not known"
    return SpawnFailed(instance.key, lost, transient=True)


def _end_of(instance: Instance, left: list[Stat], trees: ProcessTrees) -> Iterator[Event]:
    """Yield the events for an instance that ran and whose leader has ended."""
    trees.watch_strays(instance.key, left)
    if instance.pid:
        memory = trees.out_of_memory(instance.key)
        yield Exited(instance.key, UNKNOWN_EXIT, leftovers=bool(left), out_of_memory=memory)
    elif not left:
        yield SessionEnded(instance.key)
