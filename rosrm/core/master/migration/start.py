"""Start of a migration: plan by the strategy, check of executors, reservation."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from rosrm.core.master.checkpoint.images import reason_of
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration.steps import title
from rosrm.core.master.outcomes import Rejected
from rosrm.core.master.plugin_failures import why_broken
from rosrm.core.master.scheduling.ranking import Ranking
from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.migration import Migration
from rosrm.core.master.state.process import Process, ProcessPhase
from rosrm.errors import PluginError, describe_fault
from rosrm.extensions.declared_fields import unshared
from rosrm.extensions.plugin_calls import required
from rosrm.model.codec import checked
from rosrm.model.event_kinds import EventKind
from rosrm.model.plan import Aim, Commit, Move, Plan, Start, executors_of, plan_fault
from rosrm.model.values import InstanceId, ProcessSpec
from rosrm.wording import get_close_matches, listed, standing

#: Method of a strategy that returns the plan for each aim.
_HOOKS: Final = {Aim.MOVE: "propose", Aim.CHECKPOINT: "checkpoint", Aim.RESTORE: "restore"}


def begin_move(
    state: MasterState, process: Process, migration: Migration, ranking: Ranking, now: float
) -> None:
    """Begin a planned migration, with a reservation by a ranking on its destination."""
    destination, cause = migration.destination_host, migration.cause
    state.migrations[process.name] = migration
    spec = migration.spec or process.spec
    state.reserve(migration.destination, spec, destination, now, ranking)
    state.set_phase(process, ProcessPhase.MIGRATING, now, f"{migration.progress_text}: {cause}")
    how = f"by {migration.strategy}: {cause}"
    message = (
        f"{process.name} moves from {migration.source_host.name} to {destination.name} {how}"
        if migration.spec is None
        else f"{process.name} is replaced on {destination.name} {how}"
    )
    state.record(
        now, EventKind.MIGRATION_BEGUN, message,
        process=process.name, host=destination.name,
        facts={
            "from": migration.source_host.name, "to": destination.name,
            "strategy": migration.strategy, "cause": cause,
            "steps": [title(step) for step in migration.plan.steps],
            "overlap": migration.plan.overlap, "source": migration.source.number,
            "destination": migration.destination.number,
        },
    )  # fmt: skip
    state.save(process)
    state.save_migration(migration)


def plan_move(
    state: MasterState, process: Process, destination: Host, cause: str, now: float,
    new_spec: ProcessSpec | None = None,
) -> Migration | Rejected:  # fmt: skip
    """Return the planned migration of a running process, or why there is no plan.

    `new_spec`: spec of the destination, if it is another version of the process.
    """
    source = state.instances[process.owner]
    strategy, node = process.spec.migration.strategy or "", source.node_name or process.spec.node
    move = move_of(state, process, source.id, source.host, destination, node)
    return planned(state, strategy, replace(move, new_spec=new_spec), cause, now)


def move_of(
    state: MasterState, process: Process, source: InstanceId, here: Host, there: Host, node: str
) -> Move:
    """Return the input of a strategy that plans for a process; both hosts may be the same.

    `node`: name of the source's node, without its namespace.
    """
    return Move(
        process.spec, source, here.name, state.new_instance_id(process), there.name,
        state.new_instance_id(process), int(state.wall), node,
    )  # fmt: skip


def planned(
    state: MasterState, strategy: str, move: Move, cause: str, now: float, aim: Aim = Aim.MOVE
) -> Migration | Rejected:
    """Return the migration that executes the plan of a strategy, or why there is no plan."""
    plan = proposed(state, strategy, move, aim)
    if isinstance(plan, Rejected):
        return plan
    hosts = state.hosts.by_name
    source = state.instances.get(move.source.number)
    return Migration(
        move.spec.name, plan, strategy, move.source, hosts[move.source_host], move.destination,
        hosts[move.destination_host], cause, now, move.source_node, _destination_node(plan, move),
        state.wall, aim=aim, source_devices=source.devices if source else (),
        spec=move.new_spec,
    )  # fmt: skip


def moves_under_way(state: MasterState) -> int:
    """Return the number of migrations in flight; a stuck one does not block others."""
    return sum(not migration.stuck for migration in state.migrations.values())


def may_begin(state: MasterState, number: int) -> bool:
    """Return True if the bound on migrations in flight allows so many moves, which begin together.

    More moves than the bound, of processes that must stay on one host, wait until none is in
    flight.
    """
    in_flight = moves_under_way(state)
    return not in_flight or in_flight + number <= state.settings.max_migrations


def why_busy(migration: Migration) -> str:
    """Return a sentence on the current migration of a process."""
    if migration.aim is Aim.MOVE:
        return f"{migration.process} is moving already, to {migration.destination_host.name}"
    return f"{migration.process} is busy: {migration.progress_text}"


def why_cooling_down(state: MasterState, process: Process, now: float) -> str:
    """Return why a process must not move so soon after its last move; "" if it may."""
    cooldown = state.settings.cooldown
    if now - process.moved_at >= cooldown:
        return ""
    return f"{process.name} is in its cool-down of {cooldown:g} s after a move"


def why_immovable(state: MasterState, process: Process) -> str:
    """Return why a process cannot be moved now; "" if it can."""
    if process.name in state.migrations:
        return why_busy(state.migrations[process.name])
    if process.phase is ProcessPhase.CHECKPOINTED:
        return f"{process.name} is checkpointed: {reason_of(state, process)}; restore it first"
    if process.phase is not ProcessPhase.RUNNING:
        stands = standing(process.phase.value)
        return f"{process.name} {stands}; only a running process can be moved"
    if is_being_restarted(state, process):
        return f"{process.name} is being restarted; it can be moved afterwards"
    standby = state.standbys.get(process.name)
    others = process.instances - {process.owner, standby.destination.number if standby else 0}
    if others:
        return f"an earlier instance of {process.name} is still being stopped"
    return why_never_movable(state, process)


def is_being_restarted(state: MasterState, process: Process) -> bool:
    """Return True if a restart was ordered, and no status reports the new run yet.

    The slave may execute that order even after a migration has turned restarts off. A silent source
    would then publish again.
    """
    owner = state.owner_of(process)
    return owner is not None and owner.restarting is not None


def why_never_movable(state: MasterState, process: Process) -> str:
    """Return why a process cannot be moved in any phase; "" if it can."""
    strategy = process.spec.migration.strategy
    if strategy is None:
        return f"{process.name} has no migration strategy; give it `migration:` in its file"
    if strategy not in state.strategies:
        return f"{process.name}: {why_not_selected(state, strategy)}"
    return ""


def why_not_selected(state: MasterState, strategy: str) -> str:
    """Return a sentence: the configuration does not select a strategy, and the remedy."""
    near = get_close_matches(strategy, state.strategies, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return (
        f"the migration strategy {strategy!r} is not selected here{hint} (selected: "
        f"{listed(sorted(state.strategies)) or 'none'}). Choose one of these, or add it to "
        f"`migration:` in cluster.yaml, if `rosrm plugins` lists it"
    )


def why_no_executor(state: MasterState, migration: Migration) -> str:
    """Return a sentence on a host that lacks an executor of its plan; "": no host does."""
    lacking = _lacking(state, migration)
    return "" if lacking is None else _lacks(state, migration, lacking[0], [lacking[1].name])


def without_executor(state: MasterState, migration: Migration) -> tuple[list[str], str]:
    """Return all hosts that lack the executor that a plan's destination lacks, with a sentence.

    Return no host if the destination has all executors of the plan.
    """
    lacking = _lacking(state, migration)
    if lacking is None or lacking[1] is not migration.destination_host:
        return [], ""
    executor, _ = lacking
    hosts = [
        host.name
        for host in state.hosts.listed()
        if host is not migration.source_host and _has_not(host, executor)
    ]
    return hosts, _lacks(state, migration, executor, hosts)


def _lacking(state: MasterState, migration: Migration) -> tuple[str, Host] | None:
    """Return an executor of a plan and the host that lacks it; None: no host lacks any."""
    if migration.strategy not in state.declared.executors:
        return None  # the offer of the strategy is unknown
    image = migration.commit.image
    dropping = [(image, migration.source_host.name)] if image else []
    for executor, name in [*executors_of(migration.plan), *dropping]:
        host = state.hosts.by_name[name]
        if _has_not(host, executor):
            return executor, host
    return None


def _has_not(host: Host, executor: str) -> bool:
    return bool(host.description.incarnation) and executor not in host.description.executors


def _lacks(state: MasterState, migration: Migration, executor: str, hosts: list[str]) -> str:
    brought_by = state.declared.brought_by.get(migration.strategy) or "the plugin"
    one = len(hosts) == 1
    lacking = f"{listed(hosts, most=3)} {'has' if one else 'have'} no executor {executor!r}"
    lacking += f", which {migration.strategy} needs there to move {migration.process}"
    broken = ((name, why_broken(state.hosts.by_name[name], migration.strategy)) for name in hosts)
    faults = [f"on {name} {reason}" for name, reason in broken if reason]
    if faults:
        return f"{lacking}: {faults[0]}; then restart its slave"
    where, slaves = (hosts[0], "its slave") if one else ("them", "their slaves")
    return f"{lacking}: install {brought_by} on {where} and restart {slaves}"


def proposed(state: MasterState, name: str, move: Move, aim: Aim = Aim.MOVE) -> Plan | Rejected:
    """Return the plan of a named strategy, or why there is none.

    The options of the strategy, and its executors that a host lacks, are added to `move`. The
    reason names a strategy that raises.
    """

    def ask() -> Plan | Rejected:
        try:
            given = replace(
                unshared(move), options=state.declared.options_of(name, move.spec),
                lacking=_lacking_executors(state, name, move),
            )  # fmt: skip
            plan = required(getattr(state.strategies[name], _HOOKS[aim])(given), Plan)
        except ValueError as reason:  # by its contract: the strategy cannot move this process
            return _no_plan(name, describe_fault(reason))
        plan = checked(plan, Plan, "plan")  # the plan is written to the journal
        fault = plan_fault(plan, move, aim) or _executor_fault(state, name, plan)
        if fault:
            raise PluginError(f"an unsound plan: {fault}")
        return plan

    try:
        return state.plugins.ask("migration", name, _HOOKS[aim], ask, state.strategies[name])
    except PluginError as fault:
        return _no_plan(name, str(fault))


def _lacking_executors(state: MasterState, strategy: str, move: Move) -> frozenset[str]:
    """Return the executors of a strategy that the source or the destination does not have."""
    own = state.declared.executors.get(strategy, frozenset())
    hosts = [state.hosts.by_name[name] for name in (move.source_host, move.destination_host)]
    return frozenset(one for one in own if any(_has_not(host, one) for host in hosts))


def _no_plan(strategy: str, reason: str) -> Rejected:
    return Rejected(f"the migration strategy {strategy!r} gave no plan: {reason}")


def _executor_fault(state: MasterState, name: str, plan: Plan) -> str:
    """Return a sentence on an executor of a plan that its strategy's offer lacks; "": none."""
    own = state.declared.executors.get(name)
    images = [step.image for step in plan.steps if isinstance(step, Commit) and step.image]
    for executor in [*(executor for executor, _ in executors_of(plan)), *images]:
        if own is not None and executor not in own:
            there = ", ".join(sorted(own)) or "none"
            return f"it names the executor {executor!r}, which its offer lacks; its own: {there}"
    return ""


def _destination_node(plan: Plan, move: Move) -> str:
    """Return the name of the destination's node, without its namespace."""
    starts = (step for step in plan.steps if isinstance(step, Start))
    aliases = [step.node_name for step in starts if step.instance == move.destination]
    return next(iter(aliases), "") or move.destination_spec.node
