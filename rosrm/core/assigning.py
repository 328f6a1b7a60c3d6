"""Serving the queue: its head goes to the asking host that fits with the largest margin."""

from __future__ import annotations

from rosrm.core.commands import Assign
from rosrm.core.placement import Decision, Demand, Ranking, decide, why_never
from rosrm.core.state import MasterState, Process, ProcessPhase

_PLUGIN_TOLD_EVERY = 10.0


def demand_of(state: MasterState, process: Process, headroom: float = 0.0) -> Demand:
    """What decides where a process may go."""
    estimate = state.learned.estimate(process.spec, state.settings.default_needs)
    return Demand(
        process.spec,
        tuple(sorted(estimate.amounts.items())),
        tuple(sorted(process.excluded.items())),
        headroom,
    )


def ranking_of(state: MasterState, demand: Demand) -> Ranking:
    """The judgement of all hosts for a demand, up to date; kept while only assignments change it."""
    ranking = state.rankings.get(demand.key)
    if ranking is None or ranking.version != state.hosts.version:
        if ranking is not None:
            state.rankings.clear()
        ranking = Ranking(state.hosts, state.policy, demand)
        state.rankings[demand.key] = ranking
    else:
        ranking.refresh()
    return ranking


def policy_in(state: MasterState, ranking: Ranking) -> str:
    """The name of the policy that decided, or that and why it was left out."""
    if not ranking.failure:
        return state.policy_name
    return f"{state.policy_name} (left out: {ranking.failure})"


def decide_now(state: MasterState, process: Process) -> Decision:
    """What would be decided about a waiting process at this moment."""
    ranking = ranking_of(state, demand_of(state, process))
    return decide(ranking, policy_in(state, ranking))


def place_waiting(state: MasterState, now: float) -> None:
    """Assign from the queue until its head fits nowhere (with `backfill`, until nobody fits)."""
    if not len(state.queue):
        return
    if state.settings.backfill:
        _place_any(state, now)
        return
    while (name := state.queue.head()) is not None:
        if not _place_or_set_aside(state, state.processes[name], now):
            break


def _place_any(state: MasterState, now: float) -> None:
    fit_nowhere = set()
    for name in state.queue:
        process = state.processes[name]
        key = demand_of(state, process).key
        if key not in fit_nowhere and not _place_or_set_aside(state, process, now):
            fit_nowhere.add(key)


def _place_or_set_aside(state: MasterState, process: Process, now: float) -> bool:
    """False: it goes on waiting, and those behind it with it."""
    demand = demand_of(state, process)
    ranking = ranking_of(state, demand)
    column = ranking.best()
    _tell_failure(state, ranking, now)
    if column >= 0:
        _assign(state, process, ranking, column, now)
        return True
    never = why_never(state.hosts, demand)
    if never:
        _set_aside(state, process, never, now)
        return True
    _tell_waiting(state, process, now)
    return False


def _assign(state: MasterState, process: Process, ranking: Ranking, column: int, now: float) -> None:
    decision = decide(ranking, policy_in(state, ranking), chosen=column)
    host = state.hosts.hosts[column]
    instance = state.new_instance_id(process)
    state.queue.remove(process.name)
    state.add_instance(instance, process.spec, host, now)
    process.owner = instance.number
    state.set_phase(process, ProcessPhase.ASSIGNED, now)
    state.note_decision(process, decision, "assigned", now)
    state.record(
        now, "assigned", f"{process.name} goes to {host.name}", process=process.name,
        host=host.name, facts={"number": instance.number, "decision": process.decision},
    )  # fmt: skip
    state.save(process)
    state.emit(Assign(host.host_id, state.assignment(instance, process.spec)))


def _set_aside(state: MasterState, process: Process, reason: str, now: float) -> None:
    state.queue.remove(process.name)
    if process.excluded and len(process.excluded) >= len(state.hosts):
        state.set_phase(process, ProcessPhase.FAILED, now, f"no host can start it: {reason}")
        state.record(now, "failed", f"{process.name} failed: {process.reason}", process=process.name)
    else:
        state.set_phase(process, ProcessPhase.SET_ASIDE, now, f"no host may ever take it: {reason}")
        state.record(
            now, "set_aside", f"{process.name} is set aside: {process.reason}", process=process.name
        )
    state.save(process)


def reconsider_set_aside(state: MasterState, now: float) -> None:
    """A host came or changed: those that none could take return to the queue."""
    for process in state.processes.values():
        if process.phase is ProcessPhase.SET_ASIDE and not why_never(
            state.hosts, demand_of(state, process)
        ):
            state.enqueue(process, now)
            state.record(
                now, "queued", f"{process.name} returns to the queue: a host may take it now",
                process=process.name,
            )  # fmt: skip
            state.save(process)


def _tell_waiting(state: MasterState, process: Process, now: float) -> None:
    """Say once that the head of the queue waits, and why."""
    if state.queue_told == (process.name, process.reason) and process.reason:
        return
    if not len(state.hosts):
        reason = "no host has registered yet"
    else:
        reason = "no host has room for it now"
        state.note_decision(process, decide_now(state, process), "waits", now)
    process.reason = reason
    state.queue_told = (process.name, reason)
    state.record(
        now, "waits", f"{process.name} waits: {reason}", process=process.name,
        facts={"decision": process.decision} if len(state.hosts) else {},
    )  # fmt: skip


def _tell_failure(state: MasterState, ranking: Ranking, now: float) -> None:
    if not ranking.failure or now - state.policy_told < _PLUGIN_TOLD_EVERY:
        return
    state.policy_told = now
    state.record(
        now, "plugin_failed",
        f"the scoring policy {state.policy_name!r} is left out of decisions: {ranking.failure}",
    )  # fmt: skip
