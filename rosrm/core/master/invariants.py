"""Invariants of the master's state: what holds after each event, whatever was sent and lost.

Each index is compared with a recount, each reservation with the spec in force, and each instance
with its process. The tests, the simulator and the replay of a record check them after each step.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from collections.abc import Set as AbstractSet
from typing import Final

import numpy as np

from rosrm.core.master.assignment.neighbours import locate
from rosrm.core.master.graph_names import node_of
from rosrm.core.master.master_state import MasterState, process_key, version_key
from rosrm.core.master.state.arrays import array_of
from rosrm.core.master.state.host_arrays import TIE, FloatArray
from rosrm.core.master.state.pending_orders import (
    CapabilityQuery,
    InstanceAmendment,
    LinkMeasurement,
    MigrationStep,
    PeriodicCheckpoint,
    Purpose,
    Reload,
)
from rosrm.core.master.state.process import (
    BEFORE_START,
    DesiredState,
    Instance,
    Process,
    ProcessPhase,
)

#: Tolerance of sums of reservations, as fractions.
_ROUNDING: Final = 1e-6


def check(state: MasterState) -> None:
    """Raise `AssertionError` with each invariant that does not hold between two events."""
    faults = [fault for invariant in INVARIANTS for fault in invariant(state)]
    if faults:
        raise AssertionError("; ".join(faults))


def places(state: MasterState) -> Iterator[str]:
    """Check that each process is in exactly one place, which matches its phase."""
    queued = set(state.queue)
    if len(queued) != len(list(state.queue)):
        yield "a process is in the queue twice"
    yield from _differs("queue", queued, _in_phase(state, ProcessPhase.QUEUED))
    yield from _differs("set_aside", state.set_aside, _in_phase(state, ProcessPhase.SET_ASIDE))
    yield from _beyond("queue.awaiting", state.queue.awaiting, state.queue)
    yield from _beyond("queue.delayed", state.queue.delayed, state.queue)
    moving = (ProcessPhase.MIGRATING, ProcessPhase.STUCK)
    for name, process in state.processes.items():
        what, phase = f"{name} ({process.phase.value})", process.phase
        moves = name in state.migrations
        waits = name in queued or name in state.set_aside
        if phase in moving and not moves:
            yield f"{what} has no migration"
        if process.is_at_rest or waits:
            if process.owner or moves:
                yield f"{what} has the owner {process.owner}, or moves"
            if waits and process.instances:
                yield f"{what} waits, with instances {process.instances}"
        elif not (moves or process.image is not None or process.owner in process.instances):
            awaits_end = process.wanted is not DesiredState.RUN and process.instances
            if not awaits_end:
                yield f"{what} has no owner, and no instance whose end it awaits"
        if process.left_behind is not None and (
            process.is_at_rest or process.owner in state.instances
        ):
            yield f"{what} has an instance that was left behind"


def indices(state: MasterState) -> Iterator[str]:
    """Compare each index with a recount."""
    ended = {name for name, one in state.processes.items() if one.phase.is_terminal}
    live = {name: one for name, one in state.processes.items() if name not in ended}
    yield from _differs("terminal", state.terminal, ended)

    def having(read: Callable[[Process], object]) -> set[str]:
        return {name for name, one in live.items() if read(one)}

    found: list[tuple[str, Iterable[str], set[str]]] = [
        ("time_limited", state.time_limited, having(lambda one: one.spec.time_limit)),
        ("scheduled", state.scheduled, having(lambda one: one.spec.schedule)),
        ("wants_standby", state.wants_standby, having(lambda one: one.spec.standby.wanted)),
        ("neighbours", state.neighbours.declared, having(lambda one: one.spec.neighbours)),
        (
            "start_orders",
            state.start_orders.declared,
            having(lambda one: one.spec.start_order.after),
        ),
        ("images", state.images.of, {name for name, one in state.processes.items() if one.image}),
    ]
    for what, index, recount in found:
        yield from _differs(what, index, recount)
    for name, one in live.items():
        if one.node and one.node != node_of(one.spec):
            yield f"{name} has a former node"
    nodes = ((node, name) for node, names in state.nodes.items() for name in names)
    yield from _differs(
        "nodes", nodes, {(one.node, name) for name, one in live.items() if one.node}
    )


def restarts(state: MasterState) -> Iterator[str]:
    """Check that restarts which may be off are allowed again after a migration."""
    for process in state.processes.values():
        owner = state.owner_of(process)
        if owner is None or not owner.restarts_off or owner.stopping:
            continue
        if process.name not in state.migrations and process.name not in state.unamended:
            yield f"{owner.id} is not restarted, and no order to change that is due"


def declared(state: MasterState) -> Iterator[str]:
    """Compare each index with the declarations in the specs that are in force."""
    live = {name: one for name, one in state.processes.items() if not one.phase.is_terminal}
    for name, rules in state.neighbours.declared.items():
        if name in live and rules != live[name].spec.neighbours:
            yield f"neighbours has former rules of {name}"
    for name, order in state.start_orders.declared.items():
        if name in live and order != live[name].spec.start_order:
            yield f"start_orders has a former order of {name}"
    after = {
        (dependency, name)
        for name, one in live.items()
        for dependency in one.spec.start_order.after
    }
    dependants = (
        (one, name) for one, names in state.start_orders.dependants.items() for name in names
    )
    yield from _differs("dependants", dependants, after)
    for name, at in state.neighbours.located.items():
        if at != locate(state, name):
            yield f"neighbours has former hosts of {name}: {at}"
    for name, flows in state.flows.declared.items():
        if name in live and flows != live[name].spec.talks_to:
            yield f"flows has former flows of {name}"


def arrays(state: MasterState) -> Iterator[str]:
    """Check that exactly the jobs with an instance have the places of their arrays."""
    taken = state.queue.arrays.taken
    found = ((array, name) for array, names in taken.items() for name in names)
    running = {
        (array_of(one), name)
        for name, one in state.processes.items()
        if one.spec.array.name and one.instances
    }
    yield from _differs("arrays", found, running)


def gangs(state: MasterState) -> Iterator[str]:
    """Check that the index has exactly the processes that await their gang, not yet started."""
    found = [(gang, name) for gang, names in state.gangs.members.items() for name in names]
    awaiting = {(one.gang, name) for name, one in state.processes.items() if one.awaits_gang}
    yield from _differs("gangs", found, awaiting)
    for _, name in awaiting:
        process = state.processes[name]
        if process.phase not in (*BEFORE_START, ProcessPhase.UNREACHABLE):
            yield f"{name} ({process.phase.value}) awaits its gang"


def instances(state: MasterState) -> Iterator[str]:
    """Check that the instances of each process and each host are exactly the known ones."""
    by_process, strays, by_host = (defaultdict[str, set[int]](set) for _ in range(3))
    for number, instance in state.instances.items():
        name = instance.id.process
        if number != instance.id.number:
            yield f"{instance.id} has the number {number}"
        (strays if instance.stray else by_process)[name].add(number)
        by_host[instance.host.name].add(number)
        known = instance.host.instances.get(number)
        if known is None or known[0] != name or known[1] != instance.spec:
            yield f"{instance.host.name} has another spec of {instance.id}"
        if not instance.stray and name not in state.processes:
            yield f"{instance.id} has no process"
    for name, process in state.processes.items():
        yield from _differs(f"instances of {name}", process.instances, by_process[name])
    yield from _differs(
        "strays", ((name, one) for name, numbers in state.strays.items() for one in numbers),
        {(name, one) for name, numbers in strays.items() for one in numbers},
    )  # fmt: skip
    for host in state.hosts.hosts:
        yield from _differs(f"instances on {host.name}", host.instances, by_host[host.name])
        held = state.hosts.devices[host.column].held
        for number in host.instances:
            instance = state.instances[number]
            if held.get(instance.id, ()) != instance.devices:
                yield f"{instance.id} holds other devices than {host.name} has noted"
        for one in held:
            migration = state.migrations.get(one.process)
            returns = migration is not None and migration.source_host is host
            if one.number not in host.instances and not (
                returns and migration is not None and not migration.committed
            ):
                yield f"{one} has ended, and holds devices of {host.name}"


def specs(state: MasterState) -> Iterator[str]:
    """Check the spec of each instance; the owner must have the spec of its process."""
    for name, process in state.processes.items():
        spec, owner = process.spec, state.owner_of(process)
        if spec.name != name:
            yield f"{name} has the spec of {spec.name}"
        if owner is not None and owner.spec != spec:
            yield f"{owner.id} owns {name}, but has another spec"
        if process.next_spec is not None and not process.instances:
            yield f"{name} has a next spec, and no instance that ends before"
    for migration in (*state.migrations.values(), *state.standbys.values()):
        destination = state.instances.get(migration.destination.number)
        wanted = migration.spec or state.processes[migration.process].spec
        if destination is None or destination.stray:  # its host returned after the loss
            continue
        if not migration.committed and destination.spec != wanted:
            yield f"{destination.id} is not of the version that it is to replace"


def reservations(state: MasterState) -> Iterator[str]:
    """Check that each reservation matches the spec and the readings, and each load their sum."""
    for host in state.hosts.hosts:
        held = [state.instances[number] for number in host.instances]
        total = np.zeros(len(state.hosts.resources))
        for instance in held:
            if (instance.reserved < 0.0).any():
                yield f"{instance.id} reserves less than nothing"
            total[: len(instance.reserved)] += instance.reserved
            yield from _needs(state, instance)
        load = state.hosts.load[:, host.column]
        if _differ(load, total) or (load < 0.0).any():
            yield f"{host.name} has the load {load}, of its instances {total}"
        if state.hosts.processes[host.column] != len(held):
            counted = state.hosts.processes[host.column]
            yield f"{host.name} counts {counted} of its {len(held)} instances"
        if state.hosts.ties[host.column] != TIE * len(held):
            yield f"{host.name} counts its instances differently where hosts are equal"


def _needs(state: MasterState, instance: Instance) -> Iterator[str]:
    if instance.stopping or instance.stray:
        return
    for resource, amount in instance.spec.needs.items():
        if not instance.demand.get(resource, -1.0) >= amount:
            yield f"{instance.id} does not reserve what its spec needs of {resource}"
    rest = state.rest_of(instance)
    known = np.zeros(len(rest))
    known[: len(instance.reserved)] = instance.reserved
    if _differ(rest, known):
        yield f"{instance.id} reserves {known}, beyond its readings {rest}"


def _differ(some: FloatArray, others: FloatArray) -> bool:
    return not bool((np.abs(some - others) <= _ROUNDING).all())  # also of NaN


def applications(state: MasterState) -> Iterator[str]:
    """Check the versions that each application names, and that its tasks are for its processes."""
    for name, one in state.applications.items():
        for number in (one.wanted, one.former):
            if number and number not in one.versions:
                yield f"{name} has no version {number}"
        if one.newest < max(one.versions, default=0):
            yield f"{name} has a newer version than {one.newest}"
        if not one.tasks and (one.former or one.returning):
            yield f"{name} is as desired, and could return to {one.former}"
    modes = state.modes
    if modes.wanted and modes.wanted not in modes.known:
        yield f"the mode {modes.wanted} is not known"


def ledger(state: MasterState) -> Iterator[str]:
    """Check that the ledger has exactly the stored specs, each with its owner."""
    processes = {(one.principal, process_key(name)) for name, one in state.processes.items()}
    versions = {
        (one.principal, version_key(name, number))
        for name, one in state.applications.items() for number in one.versions
    }  # fmt: skip
    entries = state.ledger.items()
    found = ((principal, key) for principal, keys in entries.items() for key in keys)
    yield from _differs("ledger", found, processes | versions)


def orders(state: MasterState) -> Iterator[str]:
    """Check that each pending order belongs to an object that exists."""
    for order, purpose in state.pending_orders:
        if not _exists(state, purpose):
            yield f"the order {order} belongs to no object: {purpose}"
    yield from _beyond("migrations", state.migrations, state.processes)
    yield from _beyond("standbys", state.standbys, state.processes)
    for name, migration in state.migrations.items():
        ends = state.processes[name].phase.is_terminal
        if ends or migration.process != name:
            yield f"the migration of {name} outlives it"


def _exists(state: MasterState, purpose: Purpose) -> bool:
    match purpose:
        case MigrationStep(name):
            return name in state.processes
        case InstanceAmendment(instance):
            return instance.number < state.next_instance
        case CapabilityQuery(_, host) | LinkMeasurement(host) | Reload(host):
            return host in state.hosts.by_name
        case PeriodicCheckpoint(number):
            return number < state.next_instance
    return True


#: Every invariant.
INVARIANTS: Final[tuple[Callable[[MasterState], Iterator[str]], ...]] = (
    places, indices, declared, arrays, gangs, instances, specs, reservations, applications, ledger,
    orders, restarts,
)  # fmt: skip


def _in_phase(state: MasterState, phase: ProcessPhase) -> set[str]:
    return {name for name, process in state.processes.items() if process.phase is phase}


def _differs(what: str, index: Iterable[object], recount: AbstractSet[object]) -> Iterator[str]:
    has = set(index)
    if has != recount:
        more, fewer = sorted(map(str, has - recount)), sorted(map(str, recount - has))
        yield f"{what}: {more} too many, {fewer} missing"


def _beyond(what: str, part: Iterable[str], whole: Iterable[str]) -> Iterator[str]:
    beyond = set(part).difference(whole)
    if beyond:
        yield f"{what}: {sorted(beyond)} too many"
