"""Listings: hosts and processes as rows, and the explanation of one process."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import Any, Final

from rosrm.core.master.assignment.assign import decide_now
from rosrm.core.master.assignment.flows import described_flows
from rosrm.core.master.assignment.neighbours import awaited_neighbour
from rosrm.core.master.assignment.places import why_no_place
from rosrm.core.master.checkpoint import periodic
from rosrm.core.master.checkpoint.image_requests import why_no_checkpoint, why_no_restore
from rosrm.core.master.checkpoint.images import reason_of
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration.eviction import hosts_to_move_to
from rosrm.core.master.process_defaults import defaulted_values
from rosrm.core.master.rights import may_affect
from rosrm.core.master.schedules import why_scheduled
from rosrm.core.master.scheduling.decision import Decision, DecisionKind
from rosrm.core.master.state.devices import Inventory
from rosrm.core.master.state.hosts import Host, HostCondition
from rosrm.core.master.state.process import WAITING, DesiredState, Instance, Process, ProcessPhase
from rosrm.model.limits import limits_in_words
from rosrm.model.plan import Configure, HandoffPhase
from rosrm.model.rows import DeviceRow, HostRow, ProcessRow, ResourceRow
from rosrm.model.values import InstanceState, StopPolicy, qualified_name
from rosrm.wording import amount, listed

_CONDITION: Final = {
    HostCondition.UP: "up",
    HostCondition.SUSPECT: "suspect",
    HostCondition.LOST: "lost",
    HostCondition.LEFT: "left",
    HostCondition.EXPECTED: "expected",
    HostCondition.DETACHED: "detached",
}
#: Most names of a gang in a command.
_MOST_NAMED: Final = 8
#: Conditions in which a host reports; a host that leaves reports until its instances have ended.
_REPORTING: Final = (HostCondition.UP, HostCondition.LEFT)
_OUT_OF_REACH: Final = (HostCondition.LOST, HostCondition.DETACHED)
#: Phases that a slave observes, and that are unknown while its host is silent.
_OBSERVED: Final = (ProcessPhase.STARTING, ProcessPhase.RUNNING, ProcessPhase.BACKOFF)


def host_rows(state: MasterState, now: float) -> list[HostRow]:
    """Return every host, in order of registration."""
    return [host_row(state, host, now) for host in state.hosts.listed()]


def host_row(state: MasterState, host: Host, now: float) -> HostRow:
    """Return the row of one host."""
    table, column = state.hosts, host.column
    stale = set(table.stale_resources(host))
    condition = table.condition_of(host)
    rows = []
    for resource in host.description.resources:
        at = table.resources.index(resource.name)
        rows.append(
            ResourceRow(
                resource.name, resource.unit, resource.capacity, resource.scope,
                float(table.usage[at, column]), float(table.load[at, column]),
                float(table.limit[at, column]),
                resource.name in stale or condition is not HostCondition.UP,
            )
        )  # fmt: skip
    return HostRow(
        host.description, host.host_id, _CONDITION[condition], host.cordoned,
        host.draining, table.is_accepting(host) and condition is HostCondition.UP,
        now - float(table.last_contact[column]), tuple(rows), int(table.processes[column]),
        host.drained, _device_rows(table.devices[column]),
    )  # fmt: skip


def _device_rows(inventory: Inventory) -> tuple[DeviceRow, ...]:
    rows = []
    for device in inventory.devices:
        key = (device.kind, device.unit)
        free = min(max(inventory.free.get(key, 0.0), 0.0), 1.0)
        holders = tuple(str(one) for one in inventory.holders_of(key))
        row = DeviceRow(
            device.kind, device.unit, device.path, device.shareable, device.about, device.missing,
            free, holders,
        )  # fmt: skip
        rows.append(row)
    return tuple(rows)


def process_rows(state: MasterState, now: float) -> list[ProcessRow]:
    """Return every process, in order of submission."""
    return [process_row(state, process, now) for process in state.processes.values()]


def process_row(state: MasterState, process: Process, now: float) -> ProcessRow:
    """Return the row of one process."""
    owner = state.owner_of(process)
    seen = owner.seen if owner else {}
    silence = _silence(state, owner, now)
    phase, since = process.phase.value, now - process.since
    standby = process.standby_reason if process.phase is ProcessPhase.RUNNING else ""
    reason = _reason_of_phase(state, process) or standby or _awaited_node(process, owner)
    reason = reason or _who_is_first(state, process)
    if owner is not None and silence is not None and process.phase in _OBSERVED:
        said = f"{owner.host.name} has been silent for {silence:.0f} s"
        phase, reason, since = "unknown", f"{said}; last known: {phase}", silence
    cancelled = process.wanted is DesiredState.CANCEL and process.name not in state.migrations
    if owner is not None and cancelled:
        reason += _awaited(state, owner.host, now)
    elif owner is not None and process.phase is ProcessPhase.STOPPING:
        reason = _stopped_by_slave(state, owner, process.spec.stop, reason)
    return ProcessRow(
        name=process.name, kind=process.spec.kind.value, state=phase,
        host=_host_of(process, owner), number=process.owner,
        pid=owner.pid if owner else 0, restarts=process.restarts, migrations=process.migrations,
        exit_code=process.exit_code, priority=process.spec.priority,
        queue_position=state.queue.position(process.name), since=since,
        cpu=seen.get("cpu", 0.0), memory=int(seen.get("memory", 0.0)), reason=reason,
        cpu_limit=_limit(process, owner, "cpu"), memory_limit=int(_limit(process, owner, "memory")),
        stale=silence is not None, owner=process.principal, array=process.spec.array.name,
        next_run=0.0 if process.phase.is_terminal else process.next_run,
        application=process.spec.application,
    )  # fmt: skip


def _reason_of_phase(state: MasterState, process: Process) -> str:
    """Return why a process is in its phase; "" for no reason."""
    if process.phase is ProcessPhase.SCHEDULED:
        return why_scheduled(state, process)
    awaits_place = process.name in state.queue and process.name not in state.queue.awaiting
    return (awaits_place and why_no_place(state, process)) or reason_of(state, process)


def _who_is_first(state: MasterState, process: Process) -> str:
    """Return a phrase on the head of the queue, which a process behind it waits for; "": none."""
    if process.phase is not ProcessPhase.QUEUED or state.settings.backfill:
        return ""
    first = _first_before(state, process)
    return "" if first == process.name else f"waits behind {first}"


def _first_before(state: MasterState, process: Process) -> str:
    """Return the first process in the queue that may hold back another one that waits in it."""
    head = state.queue.head()
    if head is not None and may_affect(state.processes[head], process):
        return head
    for name in state.queue.in_turn():
        if name not in state.queue.awaiting and may_affect(state.processes[name], process):
            return name
    return process.name


def _limit(process: Process, owner: Instance | None, name: str) -> float:
    """Return a limit that holds for the owning instance; 0: none does."""
    holds = owner is not None and owner.pid and f"limits.{name}" in owner.enforced
    return float(getattr(process.spec.limits, name)) if holds else 0.0


def _silence(state: MasterState, owner: Instance | None, now: float) -> float | None:
    """Return the seconds for which the host of an instance has been silent; None: it reports."""
    if owner is None or state.hosts.condition_of(owner.host) in _REPORTING:
        return None
    return now - float(state.hosts.last_contact[owner.host.column])


def _stopped_by_slave(state: MasterState, owner: Instance, stop: StopPolicy, reason: str) -> str:
    """Return the reason; where the slave is stopping, with the cause and the time until SIGKILL."""
    if state.hosts.condition_of(owner.host) is not HostCondition.LEFT:
        return reason
    until = f"SIGKILL after {stop.interrupt_grace + stop.terminate_grace:g} s"
    return "; ".join(filter(None, (f"the slave of {owner.host.name} was stopped", reason, until)))


def _awaited(state: MasterState, host: Host, now: float) -> str:
    """Return a phrase on how long a cancelled process has waited for its host; "" for none."""
    condition = state.hosts.condition_of(host)
    if condition is HostCondition.DETACHED:
        return f" {now - host.detached_since:.0f} s ago"
    if condition is HostCondition.SUSPECT:
        silence = now - float(state.hosts.last_contact[host.column])
        return f": waits for {host.name}, which has been silent for {silence:.0f} s"
    return ""


def _host_of(process: Process, owner: Instance | None) -> str:
    if owner is not None:
        return owner.host.name
    return process.image.host if process.image is not None else process.ended_on


def _missing_standby(state: MasterState, process: Process) -> str:
    """Return the reason for the lack of a ready standby; "": one is ready, or none is wanted."""
    standby = state.standbys.get(process.name)
    step = None if standby is None else standby.current_step
    is_ready = isinstance(step, Configure) and step.phase is HandoffPhase.SWITCH
    return "" if is_ready or process.phase is not ProcessPhase.RUNNING else process.standby_reason


def _awaited_node(process: Process, owner: Instance | None) -> str:
    """Return a phrase on the node that must join the ROS graph before a process is ready."""
    if owner is None or process.phase is not ProcessPhase.STARTING:
        return ""
    spec = process.spec
    if owner.state is not InstanceState.RUNNING or not spec.ros or spec.readiness.kind == "running":
        return ""
    name = owner.node_name or spec.node
    node = f"its node {qualified_name(spec.namespace, name)}" if name else "a node of it"
    if spec.lifecycle.is_managed:
        goal, limit = spec.lifecycle.autostart, spec.ready_timeout
        return f"waits until {node} is {goal}, for at most {limit:g} s"
    return f"waits for {node} in the ROS graph, for at most {spec.readiness.timeout:g} s"


def explanation(state: MasterState, name: str, now: float) -> Mapping[str, Any] | None:
    """Return the reasons for the state and the host of a process; None: no such process."""
    process = state.processes.get(name)
    if process is None:
        return None
    row = process_row(state, process, now)
    decision, age = process.decision, now - process.decided_at
    if process.phase in WAITING:
        decision, age = decide_now(state, process), 0.0
        decision.kind = _kind_of_wait(process, decision)
    return {
        "process": name, "state": row.state, "host": row.host, "owner": row.owner,
        "reason": _reason(state, process, row), "advice": _advice(state, process),
        "decision": None if decision is None else {**decision, "elapsed": age},
        "limits": _limits(state, process),
        "defaults": defaulted_values(process.spec, process.defaulted),
        **described_flows(state, process),
        "kept": _replicas(state, process, now),
        "checkpoint": periodic.of_process(state, process, now),
        "possible": {
            "move": hosts_to_move_to(state, process),
            "checkpoint": not why_no_checkpoint(state, process),
            "restore": not why_no_restore(state, process),
        },
        "history": [
            {"elapsed": now - at, "kind": kind, "message": message}
            for at, kind, message in process.history
        ],
    }  # fmt: skip


def _kind_of_wait(process: Process, decision: Decision) -> DecisionKind:
    """Return what the hosts mean for a waiting process; one that fits may wait for another."""
    if decision.column >= 0:
        return "fits"
    return "waits" if process.phase is ProcessPhase.QUEUED else "set_aside"


def _limits(state: MasterState, process: Process) -> Mapping[str, Any]:
    """Return limits and scheduling settings of a process with their values; {}: it has none.

    If it runs: also whether each holds, and why not. For a limit below the usage of earlier runs of
    the program: also this usage.
    """
    earlier = state.learned.estimate(process.spec, {}).amounts
    owner = state.owner_of(process)
    runs = owner is not None and owner.is_running
    found: dict[str, Any] = {}
    for name, value in limits_in_words(process.spec).items():
        found[name] = {"value": value}
        used = earlier.get(name.removeprefix("limits."), 0.0)
        if used > getattr(process.spec.limits, name.removeprefix("limits."), inf):
            found[name]["used"] = amount(used, "core" if name == "limits.cpu" else "B")
        if owner is not None and runs:
            reason = owner.host.description.unenforced.get(name, "")
            holds = name in owner.enforced
            found[name] |= {"holds": holds, "reason": "" if holds else reason}
    return found


def _replicas(state: MasterState, process: Process, now: float) -> list[Mapping[str, Any]]:
    """Return the hosts with a replica of the snapshot, the newest first."""
    replicas = state.replication.replicas
    known = replicas.of(process.name)
    return [
        {
            "host": host, "number": known[host].number, "sequence": known[host].sequence,
            "size": known[host].size, "elapsed": now - known[host].since,
        }
        for host in replicas.hosts_of(process.name, process.born)
    ]  # fmt: skip


def _reason(state: MasterState, process: Process, row: ProcessRow) -> str:
    gang = (state.queue.position(name) for name in state.gangs.of(process))
    position = min(filter(None, gang), default=0)
    if row.state == "unknown":
        return row.reason
    if process.name in state.neighbours.separated:
        return state.neighbours.separated[process.name][0]
    if process.name in state.queue.awaiting:
        return process.reason
    if process.name in state.queue and (full := why_no_place(state, process)):
        return full
    if position and (awaited := awaited_neighbour(state, process)):
        return awaited
    made = state.preemption.room_made.get(process.name) if position else None
    room = made.reason if made is not None else ""
    first = _first_before(state, process) if position > 1 else process.name
    if first == process.name or room:
        owner = state.owner_of(process)
        reason = _reason_of_phase(state, process) or _missing_standby(state, process)
        reason = reason or _awaited_node(process, owner)
        return f"{reason}; {room}" if room and room != reason else reason
    ahead = f"{position - 1} before it in the queue, {first} first"
    return ahead if state.settings.backfill else f"{ahead}; `backfill` is off, so it waits for that"


def _advice(state: MasterState, process: Process) -> str:
    """Return the commands that a user may run next; "" for none."""
    owner = state.owner_of(process)
    if owner is not None and state.hosts.condition_of(owner.host) in _OUT_OF_REACH:
        return f"start the slave of {owner.host.name} again"
    logs = f"`rosrm logs {process.name}` shows its output"
    if process.phase is ProcessPhase.BACKOFF:
        return logs
    if process.phase is ProcessPhase.SCHEDULED:
        now = f"`rosrm restart {process.name}` starts a run now"
        end = f"`rosrm cancel {process.name}` ends its schedule"
        return f"{logs}, {now}, {end}" if process.ended_on else f"{now}, {end}"
    if process.phase is ProcessPhase.FAILED:
        change = _advice_to_change(state, process, "to correct it")
        again = f"`rosrm restart {process.name}` starts it again; {change}"
        return f"{logs}, {again}" if process.ended_on else again
    again = _advice_to_try_again(process) if process.phase in WAITING else ""
    if process.phase is ProcessPhase.SET_ASIDE:
        change = _advice_to_change(state, process, "to change what it needs")
        aside = f"it is queued again when such a host registers; {change}"
        return f"{aside}; {again}" if again else aside
    return again


def _advice_to_change(state: MasterState, process: Process, aim: str) -> str:
    """Return how to change the spec of a process that has failed or waits, with all of its gang."""
    if process.spec.application:
        return f"{aim}, change its file and `rosrm apply` it again"
    if process.phase.is_terminal:  # names that are in use are refused
        return f"{aim}, `rosrm submit` a file with this process alone"
    gang = state.gangs.of(process)
    names = " ".join(gang) if len(gang) <= _MOST_NAMED else "FILE"
    them = "it" if len(gang) == 1 else f"all of the gang {process.spec.together}"
    return f"{aim}, run `rosrm cancel {names}` and submit {them} again"


def _advice_to_try_again(process: Process) -> str:
    """Return the commands for a waiting process that has failed on hosts; "": it has not."""
    if not process.failed_on:
        return ""
    name, hosts = process.name, listed(process.failed_on)
    return f"`rosrm logs {name}` shows its output, `rosrm restart {name}` tries {hosts} again"
