"""Invariants of the master's state alone, whatever users, hosts and strangers have sent."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from rosrm.core.master.assignment.neighbours import locate
from rosrm.core.master.master_state import MasterState, process_key, version_key
from rosrm.core.master.state.host_arrays import TIE
from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.process import BEFORE_START, DesiredState, ProcessPhase
from rosrm.model.sizes import size_of


def no_process_is_lost(state: MasterState) -> None:
    """Check that each process is in exactly one place that matches its phase."""
    queued = {*state.queue, *state.queue.arrays}
    assert len(queued) == len(state.queue) + len(list(state.queue.arrays))
    for process in state.processes.values():
        name, phase = process.name, process.phase
        assert (phase is ProcessPhase.QUEUED) == (name in queued), (name, phase)
        assert (phase is ProcessPhase.SET_ASIDE) == (name in state.set_aside), (name, phase)
        moving = name in state.migrations
        assert moving or phase not in (ProcessPhase.MIGRATING, ProcessPhase.STUCK)
        if process.is_at_rest or name in queued or name in state.set_aside:
            assert not process.owner, (name, phase)
            assert not moving
            assert process.is_at_rest or not process.instances
        elif not moving:
            waits_for_an_end = process.wanted is not DesiredState.RUN and process.instances
            assert process.owner in state.instances or waits_for_an_end, (name, phase)
    assert queued <= set(state.processes)
    terminal = {name for name, process in state.processes.items() if process.phase.is_terminal}
    assert terminal == set(state.terminal)
    nodes = {(name, state.processes[name].node) for name in state.processes.keys() - terminal}
    indexed = {(name, node) for node, names in state.nodes.items() for name in names}
    assert indexed == {(name, node) for name, node in nodes if node}


def the_books_balance(state: MasterState) -> None:
    """Check that the load of each host is the sum over its instances and not negative."""
    of_process, strays = defaultdict(set), defaultdict(set)
    for number, instance in state.instances.items():
        of = strays if instance.stray else of_process
        of[instance.id.process].add(number)
        assert number in instance.host.instances
    for process in state.processes.values():
        assert process.instances == of_process.pop(process.name, set())
    assert not of_process
    assert state.strays == strays
    stored = defaultdict(dict)
    for process in state.processes.values():
        stored[process.principal][process_key(process.name)] = size_of(process.spec)
    for one in state.applications.values():
        for number, version in one.versions.items():
            stored[one.principal][version_key(one.name, number)] = size_of(version.specs)
    assert state.ledger.items() == stored
    for host in state.hosts.hosts:
        held = [state.instances[number] for number in host.instances]
        assert all(instance.host is host for instance in held)
        assert state.hosts.processes[host.column] == len(held)
        assert state.hosts.ties[host.column] == TIE * len(held)
        total = np.zeros(len(state.hosts.resources))
        for instance in held:
            assert (instance.reserved >= 0.0).all()
            total[: len(instance.reserved)] += instance.reserved
        assert np.allclose(state.hosts.load[:, host.column], total, atol=1e-6)
        assert (state.hosts.load[:, host.column] >= 0.0).all()
        _devices_balance(state, host)


def _devices_balance(state: MasterState, host: Host) -> None:
    """Check that only instances hold devices, and sources that a migration may start again."""
    held = state.hosts.devices[host.column].held
    for number in host.instances:
        instance = state.instances[number]
        assert held.get(instance.id, ()) == instance.devices
    for one in held:
        migration = state.migrations.get(one.process)
        returns = migration is not None and migration.source_host is host
        assert one.number in host.instances or (returns and not migration.committed), one


def gangs_are_known(state: MasterState) -> None:
    """Check that the index has exactly the processes that await their gang."""
    waiting = {one.name for one in state.processes.values() if one.awaits_gang}
    assert waiting == {name for names in state.gangs.members.values() for name in names}
    for gang, names in state.gangs.members.items():
        for name in names:
            process = state.processes[name]
            assert process.gang == gang
            assert process.phase in (*BEFORE_START, ProcessPhase.UNREACHABLE)


def known_places_are_current(state: MasterState) -> None:
    """Check that the index of neighbours has the hosts on which the processes run or may run."""
    for name, at in state.neighbours.located.items():
        assert at == locate(state, name), name
