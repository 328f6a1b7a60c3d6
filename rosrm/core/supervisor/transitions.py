"""Transition table of the supervisor; a transition changes an instance and returns commands."""

from __future__ import annotations

import signal
import zlib
from collections.abc import Callable
from typing import Final

from rosrm.core.supervisor import events
from rosrm.core.supervisor.commands import Command, ReportStatus, Signal, Spawn, Unspawn
from rosrm.core.supervisor.instance import (
    BACKOFF,
    EXITED,
    FAILED,
    FENCED,
    HELD,
    KILL_AGAIN,
    REFUSED,
    RUNNING,
    STARTING,
    STEPS,
    STOPPING,
    THEN_END,
    THEN_POLICY,
    THEN_RESTART,
    UNKNOWN_EXIT,
    WITHDRAWN,
    Instance,
    Phase,
    Then,
    end,
    ending,
    killed_for_memory,
    stopping,
)
from rosrm.core.supervisor.rules import RestartRule
from rosrm.model.durations import LONGEST
from rosrm.wording import counted

_KILL: Final = len(STEPS) - 1
#: Largest share by which a back-off is shortened, so that instances that crashed together do not
#: restart together.
_JITTER: Final = 0.2
_NEVER_STARTED: Final = "stopped before it was started"

Transition = Callable[[Instance, events.Event, float], list[Command]]


def _spawned(instance: Instance, event: events.Event, now: float) -> list[Command]:
    assert isinstance(event, events.Spawned)
    instance.phase = RUNNING
    instance.pid = event.pid
    instance.started = now
    instance.begun = now if instance.begun is None else instance.begun
    instance.message, instance.fault = event.note, ""
    instance.enforced = event.enforced
    instance.adopted = event.adopted
    instance.unfound = event.unfound
    if instance.then == THEN_END:
        return _stop(instance, event, now)
    return [ReportStatus(instance.key)]


def _spawn_failed(instance: Instance, event: events.Event, now: float) -> list[Command]:
    assert isinstance(event, events.SpawnFailed)
    instance.run_time = instance.cpu_time = instance.peak_memory = 0.0
    if instance.then == THEN_END:
        _end_as_meant(instance, _NEVER_STARTED)
    elif event.transient:
        _by_policy(instance, event.message, succeeded=False, now=now)
    else:  # the program or its directory is missing here: the master tries another host
        end(instance, REFUSED, event.message)
    return [ReportStatus(instance.key)]


def _stop_before_spawn(instance: Instance, event: events.Event, now: float) -> list[Command]:
    if instance.then == THEN_END:
        return []
    instance.then = THEN_END
    return [ReportStatus(instance.key), Unspawn(instance.key)]


def _spawn(instance: Instance, event: events.Event, now: float) -> list[Command]:
    return _start_again(instance)


def _exited(instance: Instance, event: events.Event, now: float) -> list[Command]:
    assert isinstance(event, events.Exited)
    instance.pid = 0
    instance.exit_code = event.code
    instance.exit_signal = event.signal
    instance.peak_memory = event.peak_memory
    instance.cpu_time = event.cpu_time
    instance.run_time = max(0.0, now - instance.started)
    if event.out_of_memory and (event.code or event.signal) and not instance.fault:
        instance.fault = _fault_of_memory(instance, *event.out_of_memory)
    if not event.leftovers:
        return _when_nothing_is_left(instance, now)
    if instance.phase == STOPPING:
        again: list[Command] = [Signal(instance.key, signal.SIGKILL)]
        return [ReportStatus(instance.key), *(again if instance.step >= _KILL else [])]
    return _begin_stop(instance, THEN_POLICY, now)


def _fault_of_memory(instance: Instance, used: float, limit: float) -> str:
    """Return why a run has failed in which the OOM killer ended the leader, or another process."""
    killed = killed_for_memory(used, limit)
    if instance.exit_signal == signal.SIGKILL or instance.exit_code == UNKNOWN_EXIT:
        return killed
    return f"{ending(instance)}, after a process of it was {killed}"


def _cleared(instance: Instance, event: events.Event, now: float) -> list[Command]:
    return [] if instance.pid else _when_nothing_is_left(instance, now)


def _stop(instance: Instance, event: events.Event, now: float) -> list[Command]:
    return _begin_stop(instance, THEN_END, now)


def _of_its_run(transition: Transition) -> Transition:
    """Return a transition of an order to restart that changes nothing if its run has ended."""

    def guarded(instance: Instance, event: events.Event, now: float) -> list[Command]:
        assert isinstance(event, events.RestartOrdered)
        if event.run is not None:
            pid, restarts = event.run
            if restarts != instance.restarts or instance.pid not in (0, pid):
                return []
        return transition(instance, event, now)

    return guarded


def _restart(instance: Instance, event: events.Event, now: float) -> list[Command]:
    return _begin_stop(instance, THEN_RESTART, now)


def _fail(instance: Instance, event: events.Event, now: float) -> list[Command]:
    assert isinstance(event, events.FailOrdered)
    if event.pid != instance.pid:
        return []  # the unhealthy run has already ended
    instance.fault = event.reason
    return _begin_stop(instance, THEN_POLICY, now, _KILL if event.kill else 0)


def _mean_to_end(instance: Instance, event: events.Event, now: float) -> list[Command]:
    if instance.then == THEN_END:
        return []
    instance.then = THEN_END
    instance.message = stopping(instance)
    return [ReportStatus(instance.key)]


def _mean_to_restart(instance: Instance, event: events.Event, now: float) -> list[Command]:
    if instance.then != THEN_POLICY or instance.fenced:
        return []  # the stop already leads to the end or to a restart
    instance.then = THEN_RESTART
    instance.message = stopping(instance)
    return [ReportStatus(instance.key)]


def _escalate(instance: Instance, event: events.Event, now: float) -> list[Command]:
    """Send the next signal of a stop; repeat SIGKILL, which is the last one."""
    instance.step = _KILL if _must_be_gone(instance, now) else min(instance.step + 1, _KILL)
    number = STEPS[instance.step]
    after = f" after {now - instance.stop_began:.1f} s" if instance.trail else ""
    if instance.step == _KILL:
        instance.kills += 1
    if instance.kills <= 1:
        instance.trail += f"{', ' if instance.trail else ''}{number.name}{after}"
    instance.message = stopping(instance)
    instance.deadline = now + _grace(instance, now)
    return [ReportStatus(instance.key), Signal(instance.key, number)]


def _leave_out(instance: Instance, event: events.Event, now: float) -> list[Command]:
    """Prolong a grace by a suspend, but not the time by which a fenced instance must be gone."""
    assert isinstance(event, events.Slept)
    assert instance.deadline is not None
    instance.stop_began += event.seconds
    instance.deadline += event.seconds
    if instance.kill_by is not None:
        instance.deadline = min(instance.deadline, instance.kill_by)
    return []


def _restart_due(instance: Instance, event: events.Event, now: float) -> list[Command]:
    instance.restarts += 1
    instance.recent.append(now)
    return _start_again(instance)


def _restart_now(instance: Instance, event: events.Event, now: float) -> list[Command]:
    instance.recent.clear()
    return _start_again(instance)


def _stop_in_hold(instance: Instance, event: events.Event, now: float) -> list[Command]:
    _end_as_meant(instance, _NEVER_STARTED)
    return [ReportStatus(instance.key)]


def _fence_in_hold(instance: Instance, event: events.Event, now: float) -> list[Command]:
    _take_fence(instance, event, now)
    return _stop_in_hold(instance, event, now)


def _stop_in_backoff(instance: Instance, event: events.Event, now: float) -> list[Command]:
    _end_as_meant(instance, f"stopped while it waited for its restart ({ending(instance)})")
    return [ReportStatus(instance.key)]


def _fence_before_spawn(instance: Instance, event: events.Event, now: float) -> list[Command]:
    _take_fence(instance, event, now)
    return _stop_before_spawn(instance, event, now)


def _fence(instance: Instance, event: events.Event, now: float) -> list[Command]:
    _take_fence(instance, event, now)
    return _begin_stop(instance, THEN_END, now)


def _fence_while_it_stops(instance: Instance, event: events.Event, now: float) -> list[Command]:
    _take_fence(instance, event, now)
    if instance.then == THEN_RESTART:
        instance.then = THEN_END
    if instance.step < _KILL and _must_be_gone(instance, now):
        return _escalate(instance, event, now)
    assert instance.deadline is not None
    instance.deadline = min(instance.deadline, now + _grace(instance, now))
    instance.message = stopping(instance)
    return [ReportStatus(instance.key)]


def _fence_in_backoff(instance: Instance, event: events.Event, now: float) -> list[Command]:
    _take_fence(instance, event, now)
    _end_as_meant(instance, f"it waited for its restart ({ending(instance)})")
    return [ReportStatus(instance.key)]


def _amend(instance: Instance, event: events.Event, now: float) -> list[Command]:
    assert isinstance(event, events.AmendOrdered)
    before = instance.restart, instance.enforced
    instance.restart = event.restart
    if event.held is not None:
        others = [name for name in instance.enforced if not name.startswith("limits.")]
        instance.enforced = (*event.held, *others)
    changed = before != (instance.restart, instance.enforced)
    return [ReportStatus(instance.key)] if changed else []


def _amend_in_backoff(instance: Instance, event: events.Event, now: float) -> list[Command]:
    commands = _amend(instance, event, now)
    rule = instance.restart
    if commands and (rule.when == "never" or _recent_restarts(instance, now) >= rule.attempts):
        end(instance, FAILED, f"{ending(instance)}; by its new policy it is not restarted")
    return commands


TRANSITIONS: Final[dict[tuple[Phase, type], Transition]] = {
    (HELD, events.SlotFreed): _spawn,
    (HELD, events.StopOrdered): _stop_in_hold,
    (HELD, events.FencePassed): _fence_in_hold,
    (HELD, events.FenceOrdered): _fence_in_hold,
    (HELD, events.AmendOrdered): _amend,
    (STARTING, events.Spawned): _spawned,
    (STARTING, events.SpawnFailed): _spawn_failed,
    (STARTING, events.StopOrdered): _stop_before_spawn,
    (STARTING, events.FencePassed): _fence_before_spawn,
    (STARTING, events.FenceOrdered): _fence_before_spawn,
    (STARTING, events.Resumed): _spawn,
    (STARTING, events.AmendOrdered): _amend,
    (RUNNING, events.Exited): _exited,
    (RUNNING, events.StopOrdered): _stop,
    (RUNNING, events.FencePassed): _fence,
    (RUNNING, events.FenceOrdered): _fence,
    (RUNNING, events.RestartOrdered): _of_its_run(_restart),
    (RUNNING, events.AmendOrdered): _amend,
    (RUNNING, events.FailOrdered): _fail,
    (STOPPING, events.TimePassed): _escalate,
    (STOPPING, events.Slept): _leave_out,
    (STOPPING, events.Exited): _exited,
    (STOPPING, events.SessionEnded): _cleared,
    (STOPPING, events.StopOrdered): _mean_to_end,
    (STOPPING, events.FencePassed): _fence_while_it_stops,
    (STOPPING, events.FenceOrdered): _fence_while_it_stops,
    (STOPPING, events.RestartOrdered): _of_its_run(_mean_to_restart),
    (STOPPING, events.AmendOrdered): _amend,
    (BACKOFF, events.TimePassed): _restart_due,
    (BACKOFF, events.RestartOrdered): _of_its_run(_restart_now),
    (BACKOFF, events.StopOrdered): _stop_in_backoff,
    (BACKOFF, events.FencePassed): _fence_in_backoff,
    (BACKOFF, events.FenceOrdered): _fence_in_backoff,
    (BACKOFF, events.AmendOrdered): _amend_in_backoff,
}


# --- parts of transitions ---------------------------------------------------------------------


def _start_again(instance: Instance) -> list[Command]:
    instance.phase = STARTING
    instance.deadline = None
    instance.then = ""
    instance.message = ""
    return [ReportStatus(instance.key), Spawn(instance.key)]


def _begin_stop(instance: Instance, then: Then, now: float, first: int = 0) -> list[Command]:
    """Begin a stop with the step `first`."""
    instance.phase = STOPPING
    instance.then = then
    instance.step = first - 1
    instance.kills = 0
    instance.stop_began = now
    instance.trail = ""
    return _escalate(instance, events.TimePassed(), now)


def _take_fence(instance: Instance, event: events.Event, now: float) -> None:
    """Set the latest time of SIGKILL, and the reason unless a stop for good has begun before."""
    if isinstance(event, events.FenceOrdered) or instance.fence is None:
        why, by = "it has a successor", now
    else:
        after, grace, alive = instance.fence
        missing = "activity of its slave" if alive else "confirmed contact with the master"
        why = f"no {missing} for {after:g} s"
        by = instance.heard + after + grace
    instance.kill_by = by if instance.kill_by is None else min(by, instance.kill_by)
    if instance.then != THEN_END:
        instance.fenced = f"fenced: {why}"


def _must_be_gone(instance: Instance, now: float) -> bool:
    return instance.kill_by is not None and now >= instance.kill_by


def _grace(instance: Instance, now: float) -> float:
    """Return the seconds until the next signal; a fence scales the graces to the time left."""
    if instance.step == _KILL:
        return KILL_AGAIN
    graces = (instance.stop.interrupt_grace, instance.stop.terminate_grace)
    grace = graces[instance.step]
    if instance.kill_by is None:
        return grace
    wanted = sum(graces[instance.step :])
    left = max(0.0, instance.kill_by - now)
    return grace if wanted <= left else left * grace / wanted


def _end_as_meant(instance: Instance, how: str) -> None:
    if instance.fenced:
        end(instance, FENCED, f"{instance.fenced}; {how}")
    else:
        end(instance, WITHDRAWN if instance.withdrawn else EXITED, how)


def _when_nothing_is_left(instance: Instance, now: float) -> list[Command]:
    if instance.then == THEN_RESTART:
        instance.recent.clear()
        return _start_again(instance)
    if instance.then == THEN_END:
        _end_as_meant(instance, f"stopped by {instance.trail}")
    else:
        exited_well = instance.exit_code == 0 and instance.exit_signal == 0
        succeeded = exited_well and not instance.fault
        _by_policy(instance, ending(instance), succeeded=succeeded, now=now)
    return [ReportStatus(instance.key)]


def _by_policy(instance: Instance, ending: str, *, succeeded: bool, now: float) -> None:
    rule = instance.restart
    if rule.when == "never" or (rule.when == "on-failure" and succeeded):
        end(instance, EXITED if succeeded else FAILED, "" if succeeded else ending)
        return
    if instance.fenced:
        end(instance, FENCED, f"{instance.fenced}; {ending}")
        return
    if instance.withdrawn:
        end(instance, WITHDRAWN, ending)
        return
    done = _recent_restarts(instance, now)
    if done >= rule.attempts:
        most = counted(rule.attempts, "restart")
        within = f" within {rule.window:g} s" if rule.window < LONGEST else ""
        end(instance, FAILED, f"{ending}; its restart policy allows {most}{within}")
        return
    wait = backoff(rule, done) * (1.0 - _JITTER * _chance(instance))
    instance.phase = BACKOFF
    instance.then = ""
    instance.deadline = now + wait
    instance.message = f"{ending}; restart {done + 1} of {rule.attempts} in {wait:.1f} s"


def _recent_restarts(instance: Instance, now: float) -> int:
    """Return the number of restarts within the policy's window; drop older ones."""
    instance.recent = [at for at in instance.recent if now - at < instance.restart.window]
    return len(instance.recent)


def _chance(instance: Instance) -> float:
    """Return a pseudo-random number in [0, 1), constant for each restart of each instance."""
    name, number = instance.key
    return zlib.crc32(f"{name}#{number}/{instance.restarts}".encode()) / 2**32


def backoff(rule: RestartRule, done: int) -> float:
    """Return the seconds before the next restart, after `done` restarts within the window."""
    wait = rule.delay
    for _ in range(done):
        wait = min(wait * rule.factor, rule.max_delay)
        if wait >= rule.max_delay:
            break
    return max(0.0, min(wait, rule.max_delay))
