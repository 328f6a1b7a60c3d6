"""Snapshot replication: placement of replicas by the checkpoint policy, and their removal.

A node writes its newest snapshot on its own host without an order. The master repeats each order to
a slave until the slave's report confirms it. The choices are not persisted. Each stateful process
is reviewed about once a second.

==========================================  =====================================================
observed                                    ordered
==========================================  =====================================================
a process runs, and the policy chooses      `ReplicateSnapshot`: the slave sends each snapshot of
hosts                                       this instance to them
its slave has an older choice               `ReplicateSnapshot`: the new choice
it runs, and the policy gives no answer     the last choice; without one since the master's
                                            start, `ReplicateSnapshot` to the hosts with a replica
it is cancelled, or has finished            `DropReplica` for every replica
it was submitted again                      `DropReplica` for those from before
the journal shows that it was removed       `DropReplica` for every replica
a host that is not chosen has a replica     `DropReplica`, once a chosen host has a newer replica;
                                            never before the policy has chosen
==========================================  =====================================================

Replicas of any other unknown process stay, because the journal may have lost that process. The
journal has the last 10,000 removed names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import islice
from types import MappingProxyType
from typing import Any, Final

from rosrm.core.master import events as happened
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.backoff import Backoff
from rosrm.core.master.state.hosts import Host, HostCondition
from rosrm.core.master.state.pending_orders import Replication
from rosrm.core.master.state.process import Process, ProcessPhase
from rosrm.core.master.state.replicas import Replica, ReplicationOrder
from rosrm.errors import PluginError
from rosrm.extensions.answers import exact
from rosrm.extensions.contracts import CheckpointChoice, CheckpointView
from rosrm.extensions.declared_fields import unshared
from rosrm.extensions.plugin_calls import required
from rosrm.model.event_kinds import EventKind
from rosrm.model.orders import DropReplica, ReplicateSnapshot
from rosrm.model.values import Assignment, InstanceId, SnapshotReport

#: Seconds between two reviews of the same process.
_LOOK_EVERY: Final = 1.0
#: Longest time, in seconds, until an order without effect is repeated.
_LONGEST_WAIT: Final = 60.0
#: Highest number of drop orders in memory, which prevents that one is repeated at once.
_REMEMBERED: Final = 10_000
#: Phases in which the replicas of a process are useless.
_DONE: Final = frozenset({ProcessPhase.FINISHED, ProcessPhase.CANCELLED, ProcessPhase.SCHEDULED})


# --- reports ----------------------------------------------------------------------------------


def snapshots_reported(state: MasterState, event: happened.SnapshotsReported, now: float) -> None:
    """Note all snapshots and replicas that a host reports."""
    host = state.hosts.find(event.host_id, event.incarnation)
    if host is not None:
        note_states(state, host, event.snapshots, now)


def note_states(
    state: MasterState, host: Host, states: tuple[SnapshotReport, ...], now: float
) -> None:
    """Replace the known snapshots and replicas of a host by its complete report."""
    # The journal may be lost, but no new instance may get the number of an existing snapshot.
    state.skip_numbers(max((one.instance.number for one in states), default=0))
    state.replication.replicas.replace(host.name, states, now)


def awaits_states(state: MasterState, process: Process, now: float) -> bool:
    """Return True if an absent host has or may have a replica, and may rejoin soon.

    A process that starts now might begin without its snapshot. So it waits for hosts that have not
    rejoined since the master started, until they are lost. It also waits one lease for a lost host
    other than its own, if only snapshots of earlier instances are in reach, or none: an earlier
    instance that ran on in a partition has another state than its successor.
    """
    if not state.declared.may_have_snapshots(process.spec):
        return False
    if (state.hosts.condition == HostCondition.EXPECTED).any():
        return True
    known, name = state.replication, process.name
    reached = max(
        (
            known.newest_instance(name, host)
            for host in known.in_reach(name, process.born, state.hosts)
        ),
        default=0,
    )
    return any(
        replica.number > max(reached, process.born - 1)
        and host in state.hosts.by_name
        and not _was_left_on(process, host)
        and _may_rejoin(state, state.hosts.by_name[host], now)
        for host, replica in known.replicas.of(name).items()
    )


def newest_snapshot(
    state: MasterState, assignment: Assignment, now: float
) -> Mapping[str, Any] | None:
    """Return the newest reported snapshot from which an instance may continue; None: none."""
    known = state.replication.replicas.of(assignment.instance.process)
    hosts = [name for name in assignment.snapshot_hosts if name in known]
    if not hosts:
        return None
    host = max(hosts, key=lambda name: known[name].age)
    one = known[host]
    return {
        "host": host, "number": one.number, "sequence": one.sequence, "elapsed": now - one.since
    }  # fmt: skip


def described(snapshot: Mapping[str, Any] | None) -> str:
    """Return the end of a sentence that describes a `newest_snapshot`; "": there is none."""
    if snapshot is None:
        return ""
    return (
        f"; its newest snapshot is cycle {snapshot['sequence']} of instance {snapshot['number']}, "
        f"which {snapshot['host']} reported {snapshot['elapsed']:.1f} s ago"
    )


def _may_rejoin(state: MasterState, host: Host, now: float) -> bool:
    away = state.hosts.condition_of(host) in (HostCondition.LOST, HostCondition.DETACHED)
    return away and now < host.lost_since + state.settings.lease


def _was_left_on(process: Process, host: str) -> bool:
    """Return True if the process ran on this host when the host was lost.

    `host_loss` has already delayed the process for that loss, so it does not wait longer.
    """
    return process.left_behind is not None and process.left_behind.host == host


def note_answer(state: MasterState, process: str, event: happened.OrderAnswered) -> None:
    """Note that a slave has accepted or refused the newest choice for a process."""
    last = state.replication.last_orders.get(process)
    if last is not None and last.order == event.order:
        last.accepted = event.accepted


# --- requests -------------------------------------------------------------------------------


def drop_former_replicas(state: MasterState, process: Process) -> None:
    """Make the snapshots of a restarted process void if it had finished or was cancelled."""
    if process.phase in _DONE:
        process.born = state.next_instance


# --- periodic review --------------------------------------------------------------------------


def review(state: MasterState, now: float) -> None:
    """Review a share of the processes with replicas, so that each is reviewed once a second."""
    known = state.replication
    names = known.replicas.processes()
    if len(known.drops) > _REMEMBERED:
        known.drops.clear()
    share = min(1.0, (now - known.reviewed_at) / _LOOK_EVERY)
    known.reviewed_at = now
    if (state.hosts.condition == HostCondition.EXPECTED).any():
        return  # such a host may have a replica; slaves continue with the hosts chosen before
    if not known.waiting:
        known.waiting = names[::-1]
    for _ in range(math.ceil(share * len(names))):
        if not known.waiting:
            return
        name = known.waiting.pop()
        process = state.processes.get(name)
        if process is None:
            _drop_removed(state, name, now)
        else:
            _review(state, process, now)


def _drop_removed(state: MasterState, name: str, now: float) -> None:
    """Drop every replica of a process that was removed and not submitted again."""
    end = state.replication.removed.get(name, 0)
    for host, replica in state.replication.replicas.of(name).items():
        if replica.number < end:
            _drop(state, name, host, replica, now)


def _review(state: MasterState, process: Process, now: float) -> None:
    replicas = state.replication.replicas.of(process.name)
    owner = state.owner_of(process)
    if owner is not None and owner.is_running and process.phase is ProcessPhase.RUNNING:
        _choose(state, process, owner.host, replicas, now)
    for name, replica in replicas.items():
        if _is_stale(state, process, name, replica, replicas):
            _drop(state, process.name, name, replica, now)


def _choose(
    state: MasterState, process: Process, host: Host, replicas: Mapping[str, Replica], now: float
) -> None:
    """Ask the policy, and send its choice to the slave unless the slave has it already."""
    choice = _choice(state, process, host, replicas, now)
    last = state.replication.last_orders.get(process.name)
    by_policy = choice is not None or (last is not None and last.by_policy)
    if choice is None:
        keeps = last if by_policy else None
        choice = keeps.choice if keeps else _current_choice(process, host, replicas)
    if not by_policy and not choice.hosts:
        return  # no other host has a replica, and the policy has chosen none
    incarnation, is_new, backoff = host.description.incarnation, True, Backoff()
    if last is not None:
        last.by_policy = by_policy
        is_new = (last.number, last.incarnation) != (process.owner, incarnation)
        is_new = is_new or not _is_same(last.choice, choice)
        if not is_new and (last.accepted or now < last.backoff.until):
            return
        backoff = backoff if is_new else last.backoff
    backoff.note(now, state.settings.order_retry, _LONGEST_WAIT)
    instance = InstanceId(process.name, process.owner)
    replicate = ReplicateSnapshot(instance, choice.hosts, choice.every)
    order = state.send(host, replicate, Replication(process.name))
    state.replication.last_orders[process.name] = ReplicationOrder(
        process.owner, incarnation, choice, order, backoff, by_policy
    )
    if is_new and (last is None or set(last.choice.hosts) != set(choice.hosts)):
        where = ", ".join(choice.hosts) or "no other host"
        state.record(
            now, EventKind.KEPT_ON, f"the state of {process.name} is kept on {where}",
            process=process.name, host=host.name,
            facts={"hosts": list(choice.hosts), "every": choice.every},
        )  # fmt: skip


def _current_choice(
    process: Process, host: Host, replicas: Mapping[str, Replica]
) -> CheckpointChoice:
    """Choose the other hosts with a replica from after the last submission."""
    current = (name for name, one in replicas.items() if one.number >= process.born)
    return CheckpointChoice(tuple(sorted(name for name in current if name != host.name)))


def _is_same(one: CheckpointChoice, other: CheckpointChoice) -> bool:
    """Return True if two choices differ at most in the order of their hosts."""
    return set(one.hosts) == set(other.hosts) and one.every == other.every


def _choice(
    state: MasterState, process: Process, host: Host, replicas: Mapping[str, Replica], now: float
) -> CheckpointChoice | None:
    """Return the choice of the policy; None: keep the last choice.

    A policy that raises or breaks its contract is recorded with its name.
    """
    policy, policy_name = state.replication.policy, state.replication.policy_name
    if policy is None:
        return CheckpointChoice(())
    current = state.replication.replicas.hosts_of(process.name, process.born)
    others = tuple(name for name in current if name != host.name)
    hosts = {
        one.name: MappingProxyType(one.description.labels)
        for one in state.hosts.hosts
        if _may_hold_replica(state, one, others)
    }
    since = max((replicas[name].since for name in others), default=None)
    view = CheckpointView(
        unshared(process.spec), host.name, None if since is None else now - since,
        _newest_size(replicas), others, hosts,
    )  # fmt: skip
    try:
        return state.plugins.ask(
            "checkpoint", policy_name, "choose", lambda: sound_choice(policy.choose(view), view),
            policy,
        )  # fmt: skip
    except PluginError:
        return None


def _may_hold_replica(state: MasterState, host: Host, current: tuple[str, ...]) -> bool:
    """Return True if a host may get or keep a replica; `current`: the hosts that have one.

    A suspect host keeps its replica, because it may report again within a moment.
    """
    condition = state.hosts.condition_of(host)
    return condition is HostCondition.UP or (
        condition is HostCondition.SUSPECT and host.name in current
    )


def _newest_size(replicas: Mapping[str, Replica]) -> int:
    return max(((one.age, one.size) for one in replicas.values()), default=((0, 0), 0))[1]


def sound_choice(choice: CheckpointChoice | None, view: CheckpointView) -> CheckpointChoice | None:
    """Return the choice in its declared types; raise PluginError if it breaks the contract."""
    if choice is None:
        return None
    required(choice, CheckpointChoice)
    hosts = tuple(map(exact, islice(choice.hosts, len(view.hosts) + 1)))
    choice = CheckpointChoice(hosts, float(choice.every))
    strange = [name for name in choice.hosts if name not in view.hosts or name == view.host]
    if strange or len(set(choice.hosts)) != len(choice.hosts):
        raise PluginError(
            f"it chose {', '.join(choice.hosts)} for a process on {view.host}; allowed: each of "
            f"{', '.join(name for name in view.hosts if name != view.host) or 'no host'} once"
        )
    if not 0.0 < choice.every < math.inf:
        raise PluginError(f"it chose every {choice.every} s; allowed: more than 0")
    return choice


def _is_stale(
    state: MasterState, process: Process, host: str, replica: Replica,
    replicas: Mapping[str, Replica],
) -> bool:  # fmt: skip
    """Return True if, as far as the master knows, no instance will start from a replica."""
    if replica.number < process.born or process.phase in _DONE:
        return True
    owner = state.owner_of(process)
    if owner is None or process.phase is not ProcessPhase.RUNNING or host == owner.host.name:
        return False
    last = state.replication.last_orders.get(process.name)
    if last is None or not last.by_policy or last.number != process.owner:
        return False
    if host in last.choice.hosts:
        return False
    # Keep an undesired replica until a desired host has a newer one.
    better = last.choice.hosts or (owner.host.name,)
    return any(name in replicas and replicas[name].age > replica.age for name in better)


def _drop(state: MasterState, process: str, name: str, replica: Replica, now: float) -> None:
    host = state.hosts.up(name)
    if host is None:
        return  # the host reports its replicas again when it rejoins
    backoff = state.replication.drops.setdefault((process, name, replica.number), Backoff())
    if now < backoff.until:
        return
    backoff.note(now, state.settings.order_retry, _LONGEST_WAIT)
    state.send(host, DropReplica(InstanceId(process, replica.number)), Replication(process))
