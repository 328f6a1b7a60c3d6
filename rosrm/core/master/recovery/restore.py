"""Restoration of the state at the start of a master, from the journal's intents."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import inf
from typing import Any

from rosrm.core.master.checkpoint import images
from rosrm.core.master.lifecycle import (
    FIRST_EXCLUSION,
    adopt_to_stop,
    cancelled_as,
    note_awaited_ends,
    note_phase,
)
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.modes.settings import apply_settings
from rosrm.core.master.recovery import journal_gap
from rosrm.core.master.state import applications, migration
from rosrm.core.master.state import process as processes
from rosrm.core.master.state.migration import Migration, end_from_dict, undo_steps
from rosrm.core.master.state.modes import restored_modes
from rosrm.core.master.state.process import (
    DesiredState,
    Image,
    LeftBehind,
    PendingAmendment,
    PendingRestart,
    Process,
    ProcessPhase,
)
from rosrm.model.codec import fields_from_plain, from_plain
from rosrm.model.devices import HeldDevice
from rosrm.model.event_kinds import EventKind
from rosrm.model.plan import Aim, Plan
from rosrm.model.records import Intent
from rosrm.model.values import InstanceId, ProcessSpec

_Table = Mapping[str, Mapping[str, Any]]


def restore(state: MasterState, intents: Callable[[str], _Table], now: float) -> None:
    """Fill an empty state with the intents.

    This starts and stops nothing. The running processes are reconciled with the instances on their
    hosts when the slaves register. A migration continues with its current step, whose order is
    repeated; every step is idempotent.

    `intents` returns a table of the journal by its name; `state.wall` must be set.
    """
    state.restored_at = now
    by_id = sorted(intents("host").items(), key=lambda item: int(item[1]["host_id"]))
    for name, host in by_id:
        state.hosts.expect(
            name, now, cordoned=bool(host["cordoned"]), draining=bool(host.get("draining")),
            labels=host.get("labels"),  # absent in older journals
        )  # fmt: skip
    for program, amounts in intents("learned").items():
        state.learned.restore(program, amounts)
    removed = ((int(one["next"]), name) for name, one in intents("removed").items())
    for end, name in sorted(removed):
        state.replication.removed.put(name, end)
    _restore_applications(state, intents)
    stored = sorted(intents("process").values(), key=lambda item: int(item["order"]))
    moves = intents("migration")
    for item in stored:
        process = _restore_process(state, item, now)
        move = moves.get(process.name)
        _restore_instances(state, process, item, move, now)
        _restore_standby(state, process, item, now)
        if move is None or not _restore_move(state, process, item, move, now):
            _restore_place(state, process, now)
    state.next_order = 1 + max((int(item["order"]) for item in stored), default=0)
    cluster = intents("cluster")
    numbers = cluster.get("instances", {})
    state.next_instance = state.reserved_instances = int(numbers.get("next", 1))
    state.modes = restored_modes(cluster.get("modes", {}), intents("mode"))
    apply_settings(state)
    journal_gap.restore(state, cluster)
    images.restore(state, cluster)


def _restore_applications(state: MasterState, intents: Callable[[str], _Table]) -> None:
    for name, item in intents("application").items():
        state.applications[name] = applications.application_from_dict(name, item)
    for key, item in intents("version").items():
        _, _, name = key.partition(" ")
        if name in state.applications:
            version = applications.version_from_dict(item)
            state.note_version(state.applications[name], version)
    for one in state.applications.values():
        one.versions = dict(sorted(one.versions.items()))


def _restore_process(state: MasterState, item: Mapping[str, Any], now: float) -> Process:
    phase = ProcessPhase(item["phase"])
    wall = float(item.get("since", state.wall))  # absent in older journals
    since = _restored_moment(state, item, wall, now)
    left, image = item.get("left_behind"), item.get("image")  # absent in older journals
    process = Process(
        spec=from_plain(ProcessSpec, item["spec"]), phase=phase,
        since=since, wall=wall,
        ended_on=item["host"], ran_before=float(item.get("ran_before", 0.0)),
        left_behind=from_plain(LeftBehind, left) if left else None,
        **fields_from_plain(Process, item, processes.JOURNALED),
    )  # fmt: skip
    next_spec = item.get("next_spec")  # absent in older journals
    process.next_spec = None if next_spec is None else from_plain(ProcessSpec, next_spec)
    if not item.get("amended", True):
        limits = not item.get("limits_amended", False)  # absent in older journals
        state.unamended[process.name] = PendingAmendment(limits)
    for host, why in process.excluded.items():
        process.refusals.note(host, why, now, FIRST_EXCLUSION)
    if not process.is_at_rest:
        process.exit_code, process.ended_on = None, ""
    state.add_process(process)
    images.set_image(state, process, None if image is None else from_plain(Image, image))
    return process


def _restored_moment(state: MasterState, item: Mapping[str, Any], wall: float, now: float) -> float:
    """Return a journaled time by this master's clock.

    The wall clock may have been set since. So the unix time `wall` counts only if the machine has
    booted in between, or if another machine wrote the journal.
    """
    at = _moment_of_this_boot(state, item, now)
    return now - max(0.0, state.wall - wall) if at is None else at


def _moment_of_this_boot(state: MasterState, item: Mapping[str, Any], now: float) -> float | None:
    """Return a journaled time by this master's clock; None: it is of another boot, or unknown."""
    boot, at = item.get("at") or ("", 0.0)  # absent in older journals
    return min(now, float(at)) if boot and boot == state.boot else None


def _restore_place(state: MasterState, process: Process, now: float) -> None:
    if process.phase is ProcessPhase.QUEUED:
        state.put_in_queue(process)
    elif process.phase is ProcessPhase.SET_ASIDE:
        state.set_aside.add(process.name)
    elif process.image is not None:
        trouble = process.reason if process.phase is ProcessPhase.CHECKPOINTED else ""
        images.note_checkpointed(state, process, now, trouble)
    elif not process.is_at_rest:
        _expect_to_run(state, process, now)


def _restore_instances(
    state: MasterState, process: Process, item: Mapping[str, Any],
    move: Mapping[str, Any] | None, now: float,
) -> None:  # fmt: skip
    """Add the instances that may still run: owner, source, destination, and others to stop."""
    aliases, standby = item.get("node_names", {}), item.get("standby")
    given = item.get("devices", {})  # absent in older journals
    specs = item.get("specs", {})  # absent in older journals
    # Older journals store these numbers with the migration.
    off = item.get("restarts_off", [*_suspended(move), *_suspended(standby)])
    moving = _numbers_of(move) | ({int(standby["destination"])} if standby else frozenset())
    ended = move.get("ended", {}) if move is not None else {}
    for number, host_name in item["instances"].items():
        host = state.hosts.by_name.get(host_name)
        if host is None or number in ended:
            continue
        instance = InstanceId(process.name, int(number))
        spec = from_plain(ProcessSpec, specs[number]) if number in specs else process.spec
        if instance.number == item["owner"] or instance.number in moving:
            devices = from_plain(tuple[HeldDevice, ...], given.get(number, []))
            needs = state.estimate(spec)
            held = state.add_instance(instance, spec, host, now, needs, devices=devices)
            held.node_name = str(aliases.get(number, ""))
            held.restarts_off = instance.number in off
            held.settled = number == str(item["owner"]) and _has_run(state, process, now)
        else:
            adopt_to_stop(state, instance, spec, host, now)
    process.owner = item["owner"] if item["owner"] in process.instances else 0
    restart = item.get("restart")  # absent in older journals
    if process.owner and restart:
        known = fields_from_plain(PendingRestart, restart, processes.JOURNALED_RESTART)
        at = _moment_of_this_boot(state, restart, now)
        state.instances[process.owner].restarting = PendingRestart(
            **known, ordered_at=-inf if at is None else at
        )


def _suspended(move: Mapping[str, Any] | None) -> list[int]:
    return [] if move is None else move.get("suspended", [])


def _has_run(state: MasterState, process: Process, now: float) -> bool:
    """Return True if the owner of a process has run long enough that readings show its load."""
    return process.phase is ProcessPhase.RUNNING and now - process.since >= state.settings.settle


def _expect_to_run(state: MasterState, process: Process, now: float) -> None:
    owner = state.owner_of(process)
    if owner is not None:
        note_phase(state, process, owner, now)
    elif process.instances:
        if process.wanted is not DesiredState.CANCEL:
            process.wanted = DesiredState.REQUEUE
        note_awaited_ends(state, process, now)
    elif process.wanted is DesiredState.CANCEL:
        phase, reason = cancelled_as(process)
        state.set_phase(process, phase, now, reason)
    else:
        state.enqueue(process, now, "no instance of it was left when the master started")


def _restore_standby(
    state: MasterState, process: Process, item: Mapping[str, Any], now: float
) -> None:
    """Restore the standby of a process; its node repeats the report of its phase."""
    standby = item.get("standby")
    if standby is None or int(standby["destination"]) not in process.instances:
        return
    try:
        restored = _restored_migration(state, process, standby, now)
    except (KeyError, TypeError, ValueError):
        state.instances[int(standby["destination"])].stopping = True  # another standby replaces it
        return
    restored.index = 0
    state.standbys[process.name] = restored


# --- moves ------------------------------------------------------------------------------------


def _numbers_of(move: Mapping[str, Any] | None) -> frozenset[int]:
    """Return the instance numbers of a migration; none if the migration cannot be continued."""
    if move is None or "plan" not in move:
        return frozenset()
    return frozenset({int(move["source"]), int(move["destination"]), *map(int, move["launched"])})


def _restore_move(
    state: MasterState, process: Process, item: Mapping[str, Any], move: Mapping[str, Any],
    now: float,
) -> bool:  # fmt: skip
    """Continue a migration; return False if that is impossible, and drop it."""
    try:
        restored = _restored_migration(state, process, move, now)
    except (KeyError, TypeError, ValueError) as fault:
        _discard_migration(state, process, move, str(fault), now)
        return False
    restored.is_timed = False
    process.owner = int(item["owner"])
    state.migrations[process.name] = restored
    if not restored.committed and restored.source.number not in state.instances:
        state.hosts.hold(restored.source_host, restored.source, restored.source_devices)
    for number in process.instances.intersection(move["stopping"]):
        state.instances[number].stopping = True
    state.set_phase(process, ProcessPhase.MIGRATING, now, restored.progress_text)
    host, is_move = restored.destination_host.name, restored.aim is Aim.MOVE
    continues = f" its move to {host}" if is_move else f": {restored.progress_text}"
    state.record(
        now, EventKind.MIGRATION_TAKEN_UP, f"{process.name} continues{continues}",
        process=process.name, host=host,
    )  # fmt: skip
    return True


def _restored_migration(
    state: MasterState, process: Process, move: Mapping[str, Any], now: float
) -> Migration:
    hosts = state.hosts.by_name
    plan = from_plain(Plan, move["plan"])
    wall = float(move.get("wall", state.wall))  # absent in older journals
    restored = Migration(
        process.name, plan, started=_restored_moment(state, move, wall, now),
        source=InstanceId(process.name, int(move["source"])),
        source_host=hosts[move["source_host"]],
        destination=InstanceId(process.name, int(move["destination"])),
        destination_host=hosts[move["destination_host"]],
        spec=from_plain(ProcessSpec, move["spec"]) if "spec" in move else None,
        **fields_from_plain(Migration, {"wall": wall, **move}, migration.JOURNALED),
    )  # fmt: skip
    if move["back"]:
        restored.undo = undo_steps(plan, restored.turned_at)
    for number, end in move["ended"].items():
        restored.ended[int(number)] = end_from_dict(InstanceId(process.name, int(number)), end)
    return restored


def _discard_migration(
    state: MasterState, process: Process, move: Mapping[str, Any], fault: str, now: float
) -> None:
    """Drop a migration that cannot be continued: stop all of its instances except the owner.

    An order to stop may already have reached the source, so its end counts as ordered.
    """
    source = state.instances.get(int(move["source"]))
    if source is not None and process.owner == source.id.number:
        source.recalled = True
    for instance in state.instances_of(process):
        instance.stopping = instance.id.number != process.owner
    state.unamended[process.name] = PendingAmendment()  # the move may have ordered no restarts
    message = f"the move of {process.name} cannot be continued: {fault}"
    state.record(now, EventKind.MIGRATION_FORGOTTEN, message, process=process.name)
    state.emit(Intent("migration", process.name, None))
