"""The supervisor's reducer for the instances of one host: a pure state machine.

    phase     event            commands and signals                          next phase
    -         StartOrdered     Spawn                                         starting
                               all its slots are taken: -                    held
                               its number is dead, or in a shutdown: -       refused
    -         StopOrdered      - (a later order to start is refused)         refused
              FenceOrdered     -                                             refused
              RestartOrdered   -                                             refused
              AmendOrdered     -                                             refused
    held      SlotFreed        Spawn                                         starting
              StopOrdered      -                                             exited
              FencePassed      -                                             fenced
              FenceOrdered     -                                             fenced
              AmendOrdered     -                                             held
    starting  Spawned          -                                             running
                               stop ordered in between: SIGINT               stopping
              SpawnFailed      this host cannot start it: -                  refused
                               transient: by policy                          failed, backoff
              StopOrdered      Unspawn (a begun spawn is stopped later)      starting
              FencePassed      Unspawn (a begun spawn is stopped later)      starting
              FenceOrdered     Unspawn (a begun spawn is killed later)       starting
              Resumed          Spawn (the supervisor was restarted)          starting
              AmendOrdered     - (the new policy applies from now on)        starting
    running   Exited           by policy                                     exited, failed, backoff
                               others of its session live: SIGINT            stopping
              StopOrdered      SIGINT                                        stopping
              FencePassed      SIGINT; SIGKILL within the fence's grace      stopping
              FenceOrdered     SIGKILL                                       stopping
              RestartOrdered   SIGINT; restarts afterwards                   stopping
              FailOrdered      SIGINT, or SIGKILL at once; then by policy    stopping
              AmendOrdered     -                                             running
    stopping  TimePassed       SIGTERM, then SIGKILL, then SIGKILL again     stopping
              Slept            - (its grace is longer by the suspend)        stopping
              Exited           as intended (end, restart, policy)            exited, starting, ...
                               others of its session live: -                 stopping
              SessionEnded     as intended (end, restart, policy)            exited, starting, ...
              StopOrdered      - (ends afterwards, does not restart)         stopping
              FencePassed      - (the same, within the fence's grace)        stopping
              FenceOrdered     SIGKILL (the same)                            stopping
              RestartOrdered   - (restarts afterwards, unless it must end)   stopping
              AmendOrdered     -                                             stopping
    backoff   TimePassed       Spawn                                         starting
              RestartOrdered   Spawn (the count of restarts begins at 0)     starting
              StopOrdered      -                                             exited
              FencePassed      -                                             fenced
              FenceOrdered     -                                             fenced
              AmendOrdered     - (if the policy now allows no restart)       failed, backoff
    ended     StatusStored     Drop; its number is dead                      -

An instance may have a fence: `FencePassed` occurs without an order when the last contact with the
master (`ContactReported`; the start counts as one) is too long ago. If the fence is `alive`, a
running slave counts as contact. A fenced instance is not restarted on this host, regardless of its
policy and of later orders.

`ShutdownOrdered` stops every instance as `StopOrdered` does. An instance that no order had stopped
before ends as withdrawn, not exited. So the master can distinguish this end from an end by its own
order or by the process. After a restart of the machine an instance with snapshots is withdrawn
instead of restarted by its policy (`rosrm.supervisor.takeover`).

`SlotFreed` occurs when fewer than `slots` instances other than a held one are active, that is,
neither held nor ended. The supervisor needs no client for this start, because it already has the
order.

`ClientLost` changes nothing: each instance runs on as long as its fence allows.

An order to restart one run (pid and number of restarts) changes no other run of the instance, so a
late copy of the order restarts nothing.

An event that is not in the table changes nothing. An order that changes nothing repeats the report
of the status, because DDS may repeat the order. Every change of an instance is reported
(`ReportStatus`). A signal goes to every remaining process of an instance, and never after its end.

The supervisor imports this package and must stay small. So the package does not import
`rosrm.model.values` (dataclasses alone cost 2 MiB); a test compares the values that are in both.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from rosrm.core.newest import Newest
from rosrm.core.supervisor import events
from rosrm.core.supervisor.commands import Command, Drop, Leave, ReportStatus, Spawn
from rosrm.core.supervisor.instance import (
    BACKOFF,
    HELD,
    MOST_KILLS,
    REFUSED,
    STARTING,
    THEN_END,
    Instance,
    end,
)
from rosrm.core.supervisor.rules import Key, RestartRule, StopRule
from rosrm.core.supervisor.transitions import TRANSITIONS

#: Highest number of process names with a dead number.
MOST_TOMBSTONES: Final = 2000
#: Highest number of restarts by policy within `RESTART_SPAN` seconds, so that instances that
#: crashed together do not restart together.
MOST_RESTARTS: Final = 8
RESTART_SPAN: Final = 1.0

_OrderForUnknown = (
    events.StartOrdered | events.StopOrdered | events.FenceOrdered | events.RestartOrdered
    | events.AmendOrdered
)  # fmt: skip
_Order = _OrderForUnknown | events.FailOrdered | events.StatusStored


class SupervisorState:
    """The instances of one host.

    Attributes:
        instances: all instances that were not dropped.
        dead: process name to the highest dropped number; instances up to that number never start.
        closing: a shutdown was ordered.
    """

    def __init__(self) -> None:
        self.instances: dict[Key, Instance] = {}
        self.dead = Newest[str, int](MOST_TOMBSTONES)
        self.closing = False
        self._timed: dict[Key, float] = {}
        self._active: dict[Key, Instance] = {}  # neither held nor ended
        self._held: dict[Key, Instance] = {}
        self._restarted: list[float] = []

    def restore(self, instance: Instance) -> None:
        """Restore an instance that an earlier supervisor of this host recorded."""
        self.instances[instance.key] = instance
        self._note_change(instance)

    def deadline(self) -> float | None:
        """Return the time at which `TimePassed` is due; None: no deadline is set."""
        return min(self._timed.values(), default=None)

    @property
    def next_held(self) -> Key | None:
        """Return the held instance that starts first; None: none is held."""
        return next(iter(self._held), None)

    @property
    def idle(self) -> bool:
        """Return True if no instance runs, and none will without an order."""
        return all(instance.ended for instance in self.instances.values())

    def handle(self, event: events.Event, now: float) -> list[Command]:
        """Handle an event, and return the commands."""
        commands = [*self._follow(event, now), *self._start_held(now)]
        if self.closing and self._nothing_to_wait_for():
            commands.append(Leave())
        return commands

    def _follow(self, event: events.Event, now: float) -> Iterator[Command]:
        if isinstance(event, events.TimePassed):
            due = [key for key, deadline in self._timed.items() if deadline <= now]
            for key in due:
                yield from self._fence_in_time(self.instances[key], now)
                if self._has_turn(self.instances[key], now):
                    yield from self._apply(self.instances[key], event, now)
        elif isinstance(event, events.ContactReported):
            self._renew(min(event.at, now), min(event.alive, now))
        elif isinstance(event, events.Slept):
            for instance in list(self.instances.values()):
                yield from self._apply(instance, event, now)
        elif isinstance(event, events.ShutdownOrdered):
            self.closing = True
            for instance in list(self.instances.values()):
                instance.withdrawn |= not instance.ended and instance.then != THEN_END
                yield from self._apply(instance, events.StopOrdered(instance.key), now)
        elif isinstance(event, events.ClientLost):
            return
        elif event.instance in self.instances:
            yield from self._known(self.instances[event.instance], event, now)
        elif isinstance(event, _OrderForUnknown):
            yield from self._unknown(event, now)

    def _start_held(self, now: float) -> Iterator[Command]:
        """Start held instances, in order, while a slot is free for them."""
        for instance in list(self._held.values()):
            if len(self._active) < instance.slots:
                yield from self._apply(instance, events.SlotFreed(instance.key), now)

    def _renew(self, at: float, alive: float) -> None:
        """Renew the fences of instances that are not fenced yet."""
        for instance in self.instances.values():
            if instance.fence is None or instance.fence_at is None:
                continue
            newest = max(at, alive) if instance.fence.alive else at
            if instance.heard < newest:
                instance.heard = newest
                self._note_change(instance)

    def _fence_in_time(self, instance: Instance, now: float) -> list[Command]:
        at = instance.fence_at
        if at is None or now < at:
            return []
        return self._apply(instance, events.FencePassed(instance.key), now)

    def _has_turn(self, instance: Instance, now: float) -> bool:
        """Return True if its step is due; delay a restart beyond `MOST_RESTARTS`."""
        if instance.deadline is None or now < instance.deadline:
            return False
        if instance.phase != BACKOFF:
            return True
        self._restarted = [at for at in self._restarted if now - at < RESTART_SPAN]
        if len(self._restarted) < MOST_RESTARTS:
            self._restarted.append(now)
            return True
        instance.deadline = self._restarted[0] + RESTART_SPAN
        self._note_change(instance)
        return False

    def _known(self, instance: Instance, event: events.Event, now: float) -> Iterator[Command]:
        if isinstance(event, events.StatusStored) and instance.ended:
            yield self._bury(instance)
            return
        commands = self._apply(instance, event, now)
        yield from commands
        if not commands and isinstance(event, _Order):
            yield ReportStatus(instance.key)

    def _unknown(self, event: _OrderForUnknown, now: float) -> Iterator[Command]:
        name, number = event.instance
        if isinstance(event, events.StartOrdered):
            instance = Instance(event.instance, event.restart, event.stop)
            instance.fence, instance.slots = event.fence, event.slots
            if event.slots:
                instance.phase = HELD
                instance.message = f"waits for a free slot (max_processes: {event.slots})"
            slave_counts = event.fence is not None and event.fence.alive
            known = None if slave_counts else event.heard
            instance.heard = now if known is None else min(known, now)
        else:
            instance = Instance(event.instance, RestartRule(), StopRule())
        self.instances[instance.key] = instance
        if number <= self.dead.get(name, -1):
            end(instance, REFUSED, f"{name}#{number} or a later one has ended and was forgotten")
        elif not isinstance(event, events.StartOrdered):
            end(instance, REFUSED, "it was never started here")
        elif self.closing:
            end(instance, REFUSED, "the supervisor of this host is shutting down")
        self._note_change(instance)
        yield ReportStatus(instance.key)
        if instance.phase == STARTING:
            yield Spawn(instance.key)

    def _apply(self, instance: Instance, event: events.Event, now: float) -> list[Command]:
        transition = TRANSITIONS.get((instance.phase, type(event)))
        if transition is None:
            return []
        commands = transition(instance, event, now)
        self._note_change(instance)
        return commands

    def _note_change(self, instance: Instance) -> None:
        """Enter an instance in the tables by its phase and its next deadline."""
        is_held = instance.phase == HELD
        for table, enters in (
            (self._held, is_held), (self._active, not (is_held or instance.ended)),
        ):  # fmt: skip
            if enters:
                table[instance.key] = instance
            else:
                table.pop(instance.key, None)
        due = [at for at in (instance.deadline, instance.fence_at) if at is not None]
        if due:
            self._timed[instance.key] = min(due)
        else:
            self._timed.pop(instance.key, None)

    def _bury(self, instance: Instance) -> Drop:
        name, number = instance.key
        del self.instances[instance.key]
        self.dead.put(name, max(number, self.dead.get(name, number)))
        return Drop(instance.key)

    def _nothing_to_wait_for(self) -> bool:
        return all(
            instance.ended or instance.kills > MOST_KILLS for instance in self.instances.values()
        )
