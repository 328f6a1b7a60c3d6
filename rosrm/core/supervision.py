"""What the supervisor of one host does with its instances: a pure state machine.

    phase     event            what follows                                  next phase
    -         StartOrdered     Spawn                                         starting
                               its number is dead, or all is stopped: -      refused
    -         StopOrdered      - (a start that comes late is refused)        refused
              RestartOrdered   -                                             refused
              AmendOrdered     -                                             refused
    starting  Spawned          -                                             running
                               a stop came in between: SIGINT                stopping
              SpawnFailed      final, or by policy where it may pass         failed, backoff
              StopOrdered      Unspawn (one in hand is stopped later)        starting
              Resumed          Spawn (the supervisor was restarted)          starting
              AmendOrdered     - (its policy is another from now on)         starting
    running   Exited           by policy                                     exited, failed, backoff
                               others of its session live: SIGINT            stopping
              StopOrdered      SIGINT                                        stopping
              RestartOrdered   SIGINT, to start again afterwards             stopping
              AmendOrdered     -                                             running
    stopping  TimePassed       SIGTERM, then SIGKILL, then SIGKILL again     stopping
              Exited           as was meant (end, restart, policy)           exited, starting, ...
                               others of its session live: -                 stopping
              Cleared          as was meant (end, restart, policy)           exited, starting, ...
              StopOrdered      now it is meant to end                        stopping
              RestartOrdered   unless it is meant to end: to start again     stopping
              AmendOrdered     -                                             stopping
    backoff   TimePassed       Spawn                                         starting
              RestartOrdered   Spawn, the count of restarts afresh           starting
              StopOrdered      -                                             exited
              AmendOrdered     - (if the policy now allows no restart)       failed, backoff
    ended     Forgotten        Drop; its number is dead                      -

Whatever is not in the table changes nothing; an order that changes nothing has its status told
again, as DDS may repeat it. Every change of an instance is told (`Tell`). A signal goes to every
process that is left of an instance, and none is sent after its end.

This module is imported by the supervisor, which must stay small: so nothing of `rosrm.core.model`
(dataclasses alone cost 2 MiB); a test compares the values that are in both.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

#: Process name and number: what `InstanceId` holds.
Key = tuple[str, int]

STARTING: Final = "starting"
RUNNING: Final = "running"
BACKOFF: Final = "backoff"
STOPPING: Final = "stopping"
EXITED: Final = "exited"
FAILED: Final = "failed"
REFUSED: Final = "refused"
ENDED: Final = frozenset({EXITED, FAILED, REFUSED})

#: What becomes of a stopping instance when nothing of it is left.
THEN_END: Final = "end"
THEN_RESTART: Final = "restart"
THEN_POLICY: Final = "policy"

STEPS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
_KILL: Final = len(STEPS) - 1
#: Seconds between one SIGKILL and the next, for members that were forked in between.
KILL_AGAIN: Final = 1.0
#: SIGKILLs after which a shutdown no longer waits (a process stuck in the kernel).
MOST_KILLS: Final = 5
#: Process names whose dead numbers are remembered.
MOST_TOMBSTONES: Final = 2000

#: The exit code of a run whose end nobody has seen.
UNKNOWN_EXIT: Final = -1


class RestartRule(NamedTuple):
    """`rosrm.core.model.RestartPolicy`, without its weight."""

    when: str = "never"
    delay: float = 1.0
    max_delay: float = 30.0
    factor: float = 2.0
    attempts: int = 5
    window: float = 300.0


class StopRule(NamedTuple):
    """`rosrm.core.model.StopPolicy`, without its weight."""

    interrupt_grace: float = 5.0
    terminate_grace: float = 5.0


# --- events: what happened --------------------------------------------------------------------


class StartOrdered(NamedTuple):
    """The client wants it to run."""

    instance: Key
    restart: RestartRule
    stop: StopRule


class StopOrdered(NamedTuple):
    """The client wants it to end, and not to be restarted."""

    instance: Key


class RestartOrdered(NamedTuple):
    """The client wants it stopped and started again."""

    instance: Key


class AmendOrdered(NamedTuple):
    """The client wants another restart policy for it from now on."""

    instance: Key
    restart: RestartRule


class Forgotten(NamedTuple):
    """The client has kept its final status: this side need not."""

    instance: Key


class Resumed(NamedTuple):
    """A restarted supervisor found that its start was ordered and never tried."""

    instance: Key


class Spawned(NamedTuple):
    """Its session leader runs."""

    instance: Key
    pid: int


class SpawnFailed(NamedTuple):
    """It could not be started; `transient`: the same may work later."""

    instance: Key
    message: str
    transient: bool = False


class Exited(NamedTuple):
    """Its session leader is no more.

    Attributes:
        code: exit code; UNKNOWN_EXIT: nobody saw it end.
        signal: that killed it; 0: none.
        leftovers: other processes of its session live on.
    """

    instance: Key
    code: int = 0
    signal: int = 0
    peak_memory: float = 0.0
    cpu_time: float = 0.0
    leftovers: bool = False


class Cleared(NamedTuple):
    """Its session leader was gone already, and now the others are."""

    instance: Key


class TimePassed(NamedTuple):
    """A deadline may have been reached."""


class ShutdownOrdered(NamedTuple):
    """Everything is to end, and the supervisor with it."""


class ClientLost(NamedTuple):
    """Nobody listens. The instances keep running: fencing by a timer would have its place here."""


Event = (
    StartOrdered
    | StopOrdered
    | RestartOrdered
    | AmendOrdered
    | Forgotten
    | Resumed
    | Spawned
    | SpawnFailed
    | Exited
    | Cleared
    | TimePassed
    | ShutdownOrdered
    | ClientLost
)


# --- commands: what to do ---------------------------------------------------------------------


class Spawn(NamedTuple):
    """Start it; answered by Spawned or SpawnFailed."""

    instance: Key


class Unspawn(NamedTuple):
    """Give up a spawn that was not tried yet; then answered by SpawnFailed."""

    instance: Key


class Signal(NamedTuple):
    """Send a signal to every process of it."""

    instance: Key
    number: int


class Tell(NamedTuple):
    """Record its status, then tell the client."""

    instance: Key


class Drop(NamedTuple):
    """Forget it durably."""

    instance: Key


class Leave(NamedTuple):
    """All has ended (or cannot be ended): the supervisor ends too."""


Command = Spawn | Unspawn | Signal | Tell | Drop | Leave


# --- the state --------------------------------------------------------------------------------


class Instance:
    """All that is known of one instance; JSON can hold every field.

    Attributes:
        then: what becomes of it when nothing of it is left; "" while nobody wants it stopped.
        pid: of its session leader; 0: none.
        started: when its last run began.
        recent: when the restarts within the policy's window were.
        deadline: of the next step (signal or restart); None: none is due.
        kills: how often SIGKILL was sent in this stop.
        step: the last step of the stop, an index of STEPS; -1: none.
        stop_began: when its stop began.
        trail: the steps of the stop, for people.
    """

    __slots__ = (
        "cpu_time",
        "deadline",
        "exit_code",
        "exit_signal",
        "key",
        "kills",
        "message",
        "peak_memory",
        "phase",
        "pid",
        "recent",
        "restart",
        "restarts",
        "run_time",
        "started",
        "step",
        "stop",
        "stop_began",
        "then",
        "trail",
    )

    def __init__(self, key: Key, restart: RestartRule, stop: StopRule) -> None:
        self.key = key
        self.restart = restart
        self.stop = stop
        self.phase = STARTING
        self.then = ""
        self.pid = 0
        self.exit_code = 0
        self.exit_signal = 0
        self.restarts = 0
        self.recent: list[float] = []
        self.started = 0.0
        self.deadline: float | None = None
        self.step = -1
        self.kills = 0
        self.stop_began = 0.0
        self.trail = ""
        self.peak_memory = 0.0
        self.cpu_time = 0.0
        self.run_time = 0.0
        self.message = ""

    @property
    def ended(self) -> bool:
        """Nothing of it runs, and nothing will."""
        return self.phase in ENDED


class Supervision:
    """The instances of one host.

    Attributes:
        instances: all that are not forgotten.
        dead: process name to the highest number that was forgotten: those up to it never start.
        closing: a shutdown was ordered.
    """

    def __init__(self) -> None:
        self.instances: dict[Key, Instance] = {}
        self.dead: dict[str, int] = {}
        self.closing = False
        self._timed: dict[Key, float] = {}

    def restore(self, instance: Instance) -> None:
        """Take over what an earlier supervisor of this host recorded."""
        self.instances[instance.key] = instance
        self._watch_deadline(instance)

    def deadline(self) -> float | None:
        """When `TimePassed` is due; None: never, as things are."""
        return min(self._timed.values(), default=None)

    @property
    def idle(self) -> bool:
        """Nothing runs, and nothing will unless somebody orders it."""
        return all(instance.ended for instance in self.instances.values())

    def handle(self, event: Event, now: float) -> list[Command]:
        """What follows from `event`."""
        commands = list(self._follow(event, now))
        if self.closing and self._nothing_to_wait_for():
            commands.append(Leave())
        return commands

    def _follow(self, event: Event, now: float) -> Iterator[Command]:
        if isinstance(event, TimePassed):
            due = [key for key, deadline in self._timed.items() if deadline <= now]
            for key in due:
                yield from self._apply(self.instances[key], event, now)
        elif isinstance(event, ShutdownOrdered):
            self.closing = True
            for instance in list(self.instances.values()):
                yield from self._apply(instance, StopOrdered(instance.key), now)
        elif isinstance(event, ClientLost):
            return
        elif event.instance in self.instances:
            yield from self._known(self.instances[event.instance], event, now)
        elif isinstance(event, (StartOrdered, StopOrdered, RestartOrdered, AmendOrdered)):
            yield from self._unknown(event)

    def _known(self, instance: Instance, event: Event, now: float) -> Iterator[Command]:
        if isinstance(event, Forgotten) and instance.ended:
            yield self._bury(instance)
            return
        commands = self._apply(instance, event, now)
        yield from commands
        if not commands and isinstance(event, _ORDERS):
            yield Tell(instance.key)

    def _unknown(
        self, event: StartOrdered | StopOrdered | RestartOrdered | AmendOrdered
    ) -> Iterator[Command]:
        name, number = event.instance
        starts = isinstance(event, StartOrdered)
        restart = event.restart if isinstance(event, StartOrdered) else RestartRule()
        stop = event.stop if isinstance(event, StartOrdered) else StopRule()
        instance = Instance(event.instance, restart, stop)
        self.instances[instance.key] = instance
        if number <= self.dead.get(name, -1):
            _end(instance, REFUSED, f"{name}#{number} or a later one has ended and was forgotten")
        elif not starts:
            _end(instance, REFUSED, "it was never started here")
        elif self.closing:
            _end(instance, REFUSED, "the supervisor of this host is shutting down")
        yield Tell(instance.key)
        if not instance.ended:
            yield Spawn(instance.key)

    def _apply(self, instance: Instance, event: Event, now: float) -> list[Command]:
        transition = TRANSITIONS.get((instance.phase, type(event)))
        if transition is None:
            return []
        commands = transition(instance, event, now)
        self._watch_deadline(instance)
        return commands

    def _watch_deadline(self, instance: Instance) -> None:
        if instance.deadline is None:
            self._timed.pop(instance.key, None)
        else:
            self._timed[instance.key] = instance.deadline

    def _bury(self, instance: Instance) -> Drop:
        name, number = instance.key
        del self.instances[instance.key]
        newest = max(number, self.dead.pop(name, number))
        self.dead[name] = newest
        while len(self.dead) > MOST_TOMBSTONES:
            del self.dead[next(iter(self.dead))]
        return Drop(instance.key)

    def _nothing_to_wait_for(self) -> bool:
        return all(
            instance.ended or instance.kills > MOST_KILLS for instance in self.instances.values()
        )


# --- transitions: each changes the instance and says what follows -----------------------------

Transition = Callable[[Instance, "Event", float], list[Command]]
_ORDERS: Final = (StartOrdered, StopOrdered, RestartOrdered, AmendOrdered, Forgotten)


def _spawned(instance: Instance, event: Event, now: float) -> list[Command]:
    assert isinstance(event, Spawned)
    instance.phase = RUNNING
    instance.pid = event.pid
    instance.started = now
    instance.message = ""
    if instance.then == THEN_END:
        return _stop(instance, event, now)
    return [Tell(instance.key)]


def _spawn_failed(instance: Instance, event: Event, now: float) -> list[Command]:
    assert isinstance(event, SpawnFailed)
    instance.run_time = instance.cpu_time = instance.peak_memory = 0.0
    if instance.then == THEN_END:
        _end(instance, EXITED, "stopped before it was started")
    elif event.transient:
        _by_policy(instance, event.message, succeeded=False, now=now)
    else:
        _end(instance, FAILED, event.message)
    return [Tell(instance.key)]


def _stop_before_spawn(instance: Instance, event: Event, now: float) -> list[Command]:
    if instance.then == THEN_END:
        return []
    instance.then = THEN_END
    return [Tell(instance.key), Unspawn(instance.key)]


def _spawn(instance: Instance, event: Event, now: float) -> list[Command]:
    return _start_again(instance)


def _exited(instance: Instance, event: Event, now: float) -> list[Command]:
    assert isinstance(event, Exited)
    instance.pid = 0
    instance.exit_code = event.code
    instance.exit_signal = event.signal
    instance.peak_memory = event.peak_memory
    instance.cpu_time = event.cpu_time
    instance.run_time = max(0.0, now - instance.started)
    if not event.leftovers:
        return _when_nothing_is_left(instance, now)
    if instance.phase == STOPPING:
        again: list[Command] = [Signal(instance.key, signal.SIGKILL)]
        return [Tell(instance.key), *(again if instance.step >= _KILL else [])]
    return _begin_stop(instance, THEN_POLICY, now)


def _cleared(instance: Instance, event: Event, now: float) -> list[Command]:
    return [] if instance.pid else _when_nothing_is_left(instance, now)


def _stop(instance: Instance, event: Event, now: float) -> list[Command]:
    return _begin_stop(instance, THEN_END, now)


def _restart(instance: Instance, event: Event, now: float) -> list[Command]:
    return _begin_stop(instance, THEN_RESTART, now)


def _mean_to_end(instance: Instance, event: Event, now: float) -> list[Command]:
    if instance.then == THEN_END:
        return []
    instance.then = THEN_END
    instance.message = _stopping(instance)
    return [Tell(instance.key)]


def _mean_to_restart(instance: Instance, event: Event, now: float) -> list[Command]:
    if instance.then != THEN_POLICY:
        return []  # it is meant to end, or to start again already
    instance.then = THEN_RESTART
    instance.message = _stopping(instance)
    return [Tell(instance.key)]


def _escalate(instance: Instance, event: Event, now: float) -> list[Command]:
    """The next step of a stop; after SIGKILL only that again."""
    instance.step = min(instance.step + 1, _KILL)
    number = STEPS[instance.step]
    after = f" after {now - instance.stop_began:.1f} s" if instance.step else ""
    if instance.step == _KILL:
        instance.kills += 1
    if instance.kills <= 1:
        instance.trail += f"{', ' if instance.trail else ''}{number.name}{after}"
    instance.message = _stopping(instance)
    graces = (instance.stop.interrupt_grace, instance.stop.terminate_grace, KILL_AGAIN)
    instance.deadline = now + graces[instance.step]
    return [Tell(instance.key), Signal(instance.key, number)]


def _restart_due(instance: Instance, event: Event, now: float) -> list[Command]:
    instance.restarts += 1
    instance.recent.append(now)
    return _start_again(instance)


def _restart_now(instance: Instance, event: Event, now: float) -> list[Command]:
    instance.recent.clear()
    return _start_again(instance)


def _stop_in_backoff(instance: Instance, event: Event, now: float) -> list[Command]:
    _end(instance, EXITED, f"stopped while it waited for its restart ({_ending(instance)})")
    return [Tell(instance.key)]


def _amend(instance: Instance, event: Event, now: float) -> list[Command]:
    assert isinstance(event, AmendOrdered)
    if instance.restart == event.restart:
        return []
    instance.restart = event.restart
    return [Tell(instance.key)]


def _amend_in_backoff(instance: Instance, event: Event, now: float) -> list[Command]:
    commands = _amend(instance, event, now)
    rule = instance.restart
    if commands and (rule.when == "never" or _recent_restarts(instance, now) >= rule.attempts):
        _end(instance, FAILED, f"{_ending(instance)}; by its new policy it is not restarted")
    return commands


TRANSITIONS: Final[dict[tuple[str, type], Transition]] = {
    (STARTING, Spawned): _spawned,
    (STARTING, SpawnFailed): _spawn_failed,
    (STARTING, StopOrdered): _stop_before_spawn,
    (STARTING, Resumed): _spawn,
    (STARTING, AmendOrdered): _amend,
    (RUNNING, Exited): _exited,
    (RUNNING, StopOrdered): _stop,
    (RUNNING, RestartOrdered): _restart,
    (RUNNING, AmendOrdered): _amend,
    (STOPPING, TimePassed): _escalate,
    (STOPPING, Exited): _exited,
    (STOPPING, Cleared): _cleared,
    (STOPPING, StopOrdered): _mean_to_end,
    (STOPPING, RestartOrdered): _mean_to_restart,
    (STOPPING, AmendOrdered): _amend,
    (BACKOFF, TimePassed): _restart_due,
    (BACKOFF, RestartOrdered): _restart_now,
    (BACKOFF, StopOrdered): _stop_in_backoff,
    (BACKOFF, AmendOrdered): _amend_in_backoff,
}


# --- what the transitions are made of ---------------------------------------------------------


def _start_again(instance: Instance) -> list[Command]:
    instance.phase = STARTING
    instance.deadline = None
    instance.then = ""
    instance.message = ""
    return [Tell(instance.key), Spawn(instance.key)]


def _begin_stop(instance: Instance, then: str, now: float) -> list[Command]:
    instance.phase = STOPPING
    instance.then = then
    instance.step = -1
    instance.kills = 0
    instance.stop_began = now
    instance.trail = ""
    return _escalate(instance, TimePassed(), now)


def _when_nothing_is_left(instance: Instance, now: float) -> list[Command]:
    if instance.then == THEN_RESTART:
        instance.recent.clear()
        return _start_again(instance)
    if instance.then == THEN_END:
        _end(instance, EXITED, f"stopped by {instance.trail}")
    else:
        succeeded = instance.exit_code == 0 and instance.exit_signal == 0
        _by_policy(instance, _ending(instance), succeeded=succeeded, now=now)
    return [Tell(instance.key)]


def _by_policy(instance: Instance, ending: str, *, succeeded: bool, now: float) -> None:
    rule = instance.restart
    if rule.when == "never" or (rule.when == "on-failure" and succeeded):
        _end(instance, EXITED if succeeded else FAILED, "" if succeeded else ending)
        return
    done = _recent_restarts(instance, now)
    if done >= rule.attempts:
        limit = f"{done} restarts within {rule.window:g} s are the most allowed"
        _end(instance, FAILED, f"{ending}; {limit}")
        return
    wait = backoff(rule, done)
    instance.phase = BACKOFF
    instance.then = ""
    instance.deadline = now + wait
    instance.message = f"{ending}; restart {done + 1} of {rule.attempts} in {wait:.1f} s"


def _recent_restarts(instance: Instance, now: float) -> int:
    """How many restarts lie within the policy's window; older ones count no more."""
    instance.recent = [at for at in instance.recent if now - at < instance.restart.window]
    return len(instance.recent)


def backoff(rule: RestartRule, done: int) -> float:
    """Seconds before the next restart, after `done` of them within the window."""
    wait = rule.delay
    for _ in range(done):
        wait = min(wait * rule.factor, rule.max_delay)
        if wait >= rule.max_delay:
            break
    return max(0.0, min(wait, rule.max_delay))


def _end(instance: Instance, phase: str, message: str) -> None:
    instance.phase = phase
    instance.then = ""
    instance.pid = 0
    instance.deadline = None
    instance.message = message


def _stopping(instance: Instance) -> str:
    """Why and how far it is being stopped, for people."""
    why = {
        THEN_RESTART: "to restart it: ",
        THEN_POLICY: f"{_ending(instance)}; stopping what it left: ",
    }.get(instance.then, "")
    still = f"; still there after {instance.kills} times" if instance.kills > 1 else ""
    return f"{why}{instance.trail}{still}"


def _ending(instance: Instance) -> str:
    """How its last run ended, for people."""
    if instance.exit_signal:
        return f"killed by {signal_name(instance.exit_signal)}"
    if instance.exit_code == UNKNOWN_EXIT:
        return "ended while no supervisor ran: its exit code is not known"
    return f"exit code {instance.exit_code}"


def signal_name(number: int) -> str:
    """SIGTERM for 15; a real-time signal by its number."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
