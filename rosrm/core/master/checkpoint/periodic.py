"""Periodic checkpoints: dumps of running processes, for a restart from the newest after a crash.

==================================  ==========================================================
observed                            ordered
==================================  ==========================================================
a process that requests them runs   `RunExecutor` of its strategy's step, at the policy's pace
a dump fails                        the same; the failure is recorded once for each reason
an instance with images is gone     `RunExecutor` of the strategy's executor that removes images
==================================  ==========================================================

This state is not persisted. The slave that dumps a process resumes it without a further order, and
the supervisor starts it from its image.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import Any, Final

from rosrm.core.master import events as happened
from rosrm.core.master.events import OrderOutcome
from rosrm.core.master.executor_results import number_of, seconds_of
from rosrm.core.master.hosts import capabilities
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.outcomes import Rejected
from rosrm.core.master.state.backoff import Backoff
from rosrm.core.master.state.hosts import Host, HostCondition
from rosrm.core.master.state.pending_orders import PeriodicCheckpoint
from rosrm.core.master.state.periodic import Dumped
from rosrm.core.master.state.process import Instance, Process, ProcessPhase
from rosrm.errors import PluginError
from rosrm.extensions.contracts import MemoryPacing, MemoryView, PeriodicImaging
from rosrm.extensions.declared_fields import UnknownCapabilities, unshared
from rosrm.extensions.plugin_calls import implements, required
from rosrm.model.codec import checked
from rosrm.model.event_kinds import EventKind
from rosrm.model.orders import RunExecutor
from rosrm.model.plan import Execute
from rosrm.wording import size

#: Seconds between two reviews.
_LOOK_EVERY: Final = 1.0
#: Time-out of a removal, in seconds.
_PATIENCE: Final = 30.0
#: First and longest time, in seconds, from a failed dump to the next one.
_WAITS: Final = (1.0, 600.0)


def review(state: MasterState, now: float) -> None:
    """Order due dumps and remove the images of ended instances, once a second."""
    known = state.periodic
    if now - known.reviewed_at < _LOOK_EVERY:
        return
    known.reviewed_at = now
    for number in [number for number in known.of if number not in state.instances]:
        if _remove(state, number, known.of[number], now):
            del known.of[number]
    if any(implements(one, PeriodicImaging) for one in state.strategies.values()):
        for process in state.processes.values():
            able = state.declared.capabilities_of(process.spec)
            if not isinstance(able, UnknownCapabilities) and able.restart_from_image:
                _review(state, process, now)


def note_answer(state: MasterState, number: int, event: happened.OrderAnswered, now: float) -> None:
    """Note the answer to an order to dump an instance, or to remove its images."""
    dumped = state.periodic.of.get(number)
    if dumped is None:
        return
    if dumped.removal == event.order:
        if event.outcome in (OrderOutcome.ACCEPTED, OrderOutcome.BAD_RESULT):  # the executor ran
            del state.periodic.of[number]
    elif dumped.order == event.order:
        _note(state, dumped, event, now)


def of_process(state: MasterState, process: Process, now: float) -> Mapping[str, Any] | None:
    """Return the newest checkpoint of the owning instance, for listings; None: none requested."""
    dumped = state.periodic.of.get(process.owner)
    if dumped is None:
        return None
    elapsed = now - dumped.since if dumped.made else None
    return {
        "elapsed": elapsed, "size": dumped.size, "pause": dumped.pause, "trouble": dumped.trouble,
    }  # fmt: skip


# --- due dumps --------------------------------------------------------------------------------


def _review(state: MasterState, process: Process, now: float) -> None:
    name = process.spec.migration.strategy or ""
    strategy: object = state.strategies.get(name)
    owner = state.owner_of(process)
    if owner is None or not implements(strategy, PeriodicImaging):
        return
    number, host = process.owner, owner.host
    dumped = state.periodic.of.get(number)
    if dumped is None:
        discard = _discard_of(state, name)
        dumped = state.periodic.of[number] = Dumped(process.name, host.name, name, discard, now)
    if dumped.order is not None and dumped.asked != host.description.incarnation:
        dumped.order, dumped.since = None, now  # the dump ended with the former run of the slave
    if dumped.order is not None or not _may_be_dumped(state, process, owner):
        return
    pace = _pace(state, process, strategy, host, dumped)
    if isinstance(pace, Rejected):
        _record_trouble(state, dumped, pace.reason, now)
    elif pace is not None and now >= max(dumped.since + pace, dumped.backoff.until):
        trouble = capabilities.fault(state, name, host, host)
        if trouble:
            _record_trouble(state, dumped, trouble, now)
        else:
            _order(state, process, strategy, owner, dumped, now)


def _discard_of(state: MasterState, name: str) -> str | Rejected | None:
    """Return the name of a strategy's executor that removes images; None: there is none."""
    strategy: object = state.strategies.get(name)
    if not implements(strategy, PeriodicImaging):
        return None
    asked = strategy
    try:
        return state.plugins.ask(
            "migration", name, "discard", lambda: required(asked.discard, str), asked
        )
    except PluginError as error:
        return Rejected(str(error))


def _may_be_dumped(state: MasterState, process: Process, owner: Instance) -> bool:
    """Return True if a process runs on a host that is up, and is neither moved nor stopped."""
    return (
        process.phase is ProcessPhase.RUNNING
        and owner.is_running
        and not owner.stopping
        and owner.restarting is None
        and process.name not in state.migrations
        and state.hosts.condition_of(owner.host) is HostCondition.UP
    )


def _pace(
    state: MasterState, process: Process, strategy: PeriodicImaging, host: Host, dumped: Dumped
) -> float | Rejected | None:
    """Return the seconds between two dumps; None: the process requests none."""
    policy, name = state.replication.policy, state.replication.policy_name
    if policy is None:
        return Rejected("no checkpoint policy is selected: name one in the cluster's file")
    if not implements(policy, MemoryPacing):
        return Rejected(f"the checkpoint policy {name!r} makes none of memory")
    pacing = policy
    asked_of = process.spec.migration.strategy or ""
    try:
        asked = state.plugins.ask(
            "migration", asked_of, "checkpoint_every",
            lambda: float(strategy.checkpoint_every(unshared(process.spec))), strategy,
        )  # fmt: skip
        if not asked > 0.0:
            return None
        view = MemoryView(unshared(process.spec), host.name, asked, dumped.size, dumped.pause)
        asked_of = name
        return state.plugins.ask(
            "checkpoint", name, "pace", lambda: sound_pace(pacing.pace(view)), pacing
        )
    except PluginError as error:
        return Rejected(f"{asked_of!r} sets no pace: {error}")


def sound_pace(pace: float | None) -> float | None:
    """Return the pace as a float; raise PluginError for a pace that breaks the contract."""
    if pace is None:
        return None
    number = float(pace)
    if not 0.0 < number < inf:
        raise PluginError(f"one every {number} s; allowed: more than 0")
    return number


def _order(
    state: MasterState, process: Process, strategy: PeriodicImaging, owner: Instance,
    dumped: Dumped, now: float,
) -> None:  # fmt: skip
    spec, host = process.spec, owner.host.name

    def ask() -> Execute:
        step = required(strategy.periodic(unshared(spec), owner.id, host, int(state.wall)), Execute)
        return checked(step, Execute, "step")

    try:
        step = state.plugins.ask(
            "migration", spec.migration.strategy or "", "periodic", ask, strategy
        )
    except PluginError as error:
        _record_trouble(state, dumped, str(error), now)
        return
    dump = RunExecutor(step.executor, step.arguments, step.timeout)
    dumped.order = state.send(owner.host, dump, PeriodicCheckpoint(owner.id.number))
    dumped.asked = owner.host.description.incarnation


# --- results ----------------------------------------------------------------------------------


def _note(state: MasterState, dumped: Dumped, event: happened.OrderAnswered, now: float) -> None:
    dumped.order, dumped.since = None, now
    if not event.accepted:
        dumped.backoff.note(now, *_WAITS)
        _record_trouble(state, dumped, event.reason, now)
        return
    dumped.backoff = Backoff()
    result = event.result or {}
    dumped.size = int(number_of(result.get("size")))
    parts = seconds_of(result)
    dumped.pause = sum(parts.values())
    recorded = dumped.made and not dumped.trouble
    dumped.made, dumped.trouble = True, ""
    if not recorded:
        state.record(
            now, EventKind.PERIODIC_CHECKPOINT,
            f"the first periodic checkpoint of {dumped.process} is made ({size(dumped.size)}, "
            f"paused for {dumped.pause:.2f} s): a crash starts the process from the newest",
            process=dumped.process, host=dumped.host,
            facts={"size": dumped.size, "seconds": parts},
        )  # fmt: skip


def _record_trouble(state: MasterState, dumped: Dumped, trouble: str, now: float) -> None:
    """Record a failure of periodic checkpoints, once until the reason changes."""
    if trouble == dumped.trouble:
        return
    dumped.trouble = trouble
    state.record(
        now, EventKind.PERIODIC_FAILED,
        f"no periodic checkpoint of {dumped.process} was made: {trouble}",
        process=dumped.process, host=dumped.host,
    )  # fmt: skip


def _remove(state: MasterState, number: int, dumped: Dumped, now: float) -> bool:
    """Order the removal of an instance's images; return False until none is left to order.

    The slave of a host that is not up removes them when it registers.
    """
    host = state.hosts.up(dumped.host)
    if host is None:
        return True
    if isinstance(dumped.discard, Rejected):
        dumped.discard = _discard_of(state, dumped.strategy)
    if isinstance(dumped.discard, Rejected):
        return False
    if not dumped.discard:
        return True
    if dumped.removal is None:
        dumped.backoff = Backoff()
    if now >= dumped.backoff.until:
        dumped.backoff.note(now, _PATIENCE + _WAITS[0], _WAITS[1])
        remove = RunExecutor(dumped.discard, timeout=_PATIENCE)
        dumped.removal = state.send(host, remove, PeriodicCheckpoint(number))
    return False
