"""Creation of a lab, power and network of its hosts, and removal of everything."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Callable, Iterator, Sequence
from ipaddress import IPv4Network

from rosrm.errors import LabError
from rosrm.supervisor.procfs import boot_id
from rosrm_lab import disks, groups, network, store
from rosrm_lab.groups import Hierarchy
from rosrm_lab.host import boot, power_off
from rosrm_lab.plan import check_free, free_subnet, host_namespace, namespaces_of
from rosrm_lab.store import LabRecord
from rosrm_lab.wires import Link


@contextlib.contextmanager
def explained(lab: str) -> Iterator[None]:
    """Turn an error of this machine (a file, a program or a process) into a `LabError`.

    Args:
        lab: that is being changed.
    """
    try:
        yield
    except (OSError, subprocess.SubprocessError) as error:
        raise LabError(
            f"lab {lab!r}: this machine refuses what a lab needs: {error}. A container needs "
            "`docker run --privileged`"
        ) from error


def refuse_if_up(lab: str) -> None:
    """Raise `LabError` where a lab of this name is up, and not abandoned."""
    record = store.read(lab)
    if record is None or not record.complete or record.boot != boot_id():
        return
    if record.owner is not None and not record.owner.alive:
        return
    raise LabError(
        f"lab {lab!r} is up already, with {', '.join(record.plan.names)}. "
        "`rosrm lab down` removes it; another name (`--lab NAME`) makes a second one"
    )


def choose_subnet(wanted: IPv4Network | None) -> IPv4Network:
    """Return the address range of a new lab.

    Args:
        wanted: None: any free range.

    Raises:
        ConfigError: the range is in use.
    """
    labs = [(one, store.read(one)) for one in store.labs()]
    taken = [
        *network.ranges_in_use(),
        *((known.plan.subnet, f"lab {name!r}") for name, known in labs if known is not None),
    ]
    if wanted is None:
        return free_subnet([subnet for subnet, _ in taken])
    check_free(wanted, taken)
    return wanted


def make(hierarchies: Sequence[Hierarchy], record: LabRecord, between: Callable[[], None]) -> None:
    """Make everything in a lab's record, and mark it as complete; raises `LabError`.

    Args:
        between: called before each host and after the last, and may raise.
    """
    plan = record.plan
    record.links = {name: Link() for name in plan.names}
    network.make_switch(plan)
    for host in plan.hosts:
        between()
        groups.make(hierarchies, plan.name, host)
        disks.make(store.image(plan.name, host.name), host)
        switch_on(hierarchies, record, host.name)
    between()
    record.complete = True
    store.write(record)


def switch_on(hierarchies: Sequence[Hierarchy], record: LabRecord, host: str) -> None:
    """Connect a host and start its first process, or leave nothing of it; raises `LabError`."""
    switch_off(hierarchies, record, host)  # remains of an earlier, partly killed run of the host
    plan = record.plan
    try:
        network.plug_in(plan, host, record.links[host])
        record.inits[host] = boot(hierarchies, plan.name, plan.host(host), plan.hosts_file())
    except BaseException:
        switch_off(hierarchies, record, host)
        raise


def switch_off(hierarchies: Sequence[Hierarchy], record: LabRecord, host: str) -> None:
    """Cut a host's power: first remove its network, then end its processes."""
    plan = record.plan
    network.unplug(plan, host)
    power_off(hierarchies, plan.name, host, record.inits.pop(host, None))
    mine = host_namespace(plan.name, host)
    network.remove([name for name in network.existing() if name == mine])


def change_link(record: LabRecord, host: str, before: Link, after: Link) -> None:
    """Apply the faults of a host's network: all of them, or none; raises `LabError`."""
    if record.is_up(host):
        network.set_delays(record.plan, host, before, after)
    elif after.delays and after != before:
        raise LabError(f"host {host} is off: switch it on (`rosrm lab boot {host}`) to delay it")
    try:
        network.set_rules(record.plan, {**record.links, host: after})
    except BaseException:
        if record.is_up(host):
            network.set_delays(record.plan, host, after, before)
        raise
    record.links[host] = after


def remove(hierarchies: Sequence[Hierarchy], lab: str) -> bool:
    """Remove all parts of a lab, with or without a record; False: there were none.

    Raises:
        LabError: a part could not be removed; a second call continues.
    """
    namespaces = list(namespaces_of(lab, network.existing()))
    if not namespaces and lab not in store.labs() | groups.labs(hierarchies):
        return False
    # The groups hold every process of the lab: first processes, and all that were started there.
    groups.remove(hierarchies, lab)
    network.remove(namespaces)
    store.forget(lab)
    return True
