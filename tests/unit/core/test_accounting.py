"""Accounting of resources: what a declared need reserves, and who is evicted for a limit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rosrm.core.master import master_state
from rosrm.core.master.events import UsagesReceived
from rosrm.core.master.state import learned_needs
from rosrm.model.values import Accounting, ResourceDescription, RestartPolicy
from tests.unit.core.cluster import GIB, Cluster, Machine, job, movable, process

#: Seconds, shorter than the waits of these tests.
SETTLE = 1.0


def host(name: str, resource: str, accounting: Accounting, capacity: float = 10.0) -> Machine:
    """Return a host with memory and one more resource, of which 80 % are allowed."""
    resources = (
        ResourceDescription("memory", "B", 16 * GIB),
        ResourceDescription(resource, "1", capacity, "machine", accounting),
    )
    return Machine(name, resources=resources, limits={resource: 0.8})


def running(needs: dict[str, float], **fields: Any) -> Any:
    return process("p", needs=needs, restart=RestartPolicy("always"), **fields)


def reserved(cluster: Cluster, resource: str) -> float:
    """Return the reserved part of host a, in units of the resource."""
    table, machine = cluster.state.hosts, cluster.machines["a"]
    one = next(one for one in machine.resources if one.name == resource)
    host = table.by_name["a"]
    return float(table.load[table.resources.index(resource), host.column]) * one.capacity


def test_gpu_memory_counts_once() -> None:
    """Two processes of 3 GiB fit in 8 GiB, whether the readings show the first one or not."""
    gpu = host("a", "gpu_memory", "attributed", 8 * GIB)
    cluster = Cluster(gpu, settle=SETTLE)
    gpu.shown["p"] = {"gpu_memory": 3 * GIB}
    cluster.submit(running({"gpu_memory": 3 * GIB}))
    cluster.wait(0.3)
    assert reserved(cluster, "gpu_memory") == 0.0
    cluster.submit(process("q", needs={"gpu_memory": 3 * GIB}))
    assert cluster.where("q") == ["a"]
    assert reserved(cluster, "gpu_memory") == pytest.approx(3 * GIB)


def test_the_unused_part_of_an_attributed_need_stays_reserved() -> None:
    """A process may still take what it declared."""
    gpu = host("a", "gpu_memory", "attributed")
    cluster = Cluster(gpu, settle=SETTLE).with_processes(running({"gpu_memory": 5.0}))
    gpu.shown["p"] = {"gpu_memory": 2.0}
    cluster.wait(10.0)
    assert reserved(cluster, "gpu_memory") == pytest.approx(3.0)


def test_a_shared_need_is_reserved_until_the_process_is_ready_and_settled() -> None:
    """The readings then show its load. After a crash nothing runs, and it is reserved again."""
    cluster = Cluster(host("a", "gpu", "shared"), settle=SETTLE)
    cluster.submit(running({"gpu": 5.0}))
    assert reserved(cluster, "gpu") == pytest.approx(5.0)
    cluster.wait(0.5)
    assert reserved(cluster, "gpu") == pytest.approx(5.0)
    cluster.wait(1.0)
    assert reserved(cluster, "gpu") == 0.0
    cluster.finish("p", code=1)
    cluster.wait(0.3)
    assert reserved(cluster, "gpu") == pytest.approx(5.0)
    cluster.wait(1.0)
    assert reserved(cluster, "gpu") == 0.0


def test_a_countable_need_is_reserved_as_long_as_the_instance() -> None:
    """No reading shows it."""
    cluster = Cluster(host("a", "licence", "countable"), settle=SETTLE)
    cluster.submit(job("p", needs={"licence": 5.0}))
    cluster.wait(60.0)
    assert reserved(cluster, "licence") == pytest.approx(5.0)
    cluster.finish("p")
    assert reserved(cluster, "licence") == 0.0


def test_the_measured_peak_of_an_attributed_resource_is_learned() -> None:
    """The next run of the program that declares nothing counts with it."""
    gpu = host("a", "gpu_memory", "attributed")
    cluster = Cluster(gpu, settle=SETTLE).with_processes(job("p"))
    gpu.shown["p"] = {"gpu_memory": 4.0}
    cluster.wait(1.0)
    cluster.finish("p")
    cluster.submit(process("q"))
    assert cluster.explain("q")["decision"]["need"]["gpu_memory"] == 4.0


def test_only_the_programs_run_last_are_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each job of a sweep over parameters is a program; the master does not grow with them."""
    monkeypatch.setattr(master_state, "MOST_PROGRAMS", 3)
    monkeypatch.setattr(learned_needs, "MOST_PROGRAMS", 3)
    gpu = host("a", "gpu_memory", "attributed")
    cluster = Cluster(gpu, settle=SETTLE)
    for run, seed in enumerate([0, 1, 2, 3, 1, 4]):
        cluster.submit(job(f"p{run}", command=("run", f"--seed={seed}")))
        gpu.shown[f"p{run}"] = {"gpu_memory": 1.0 + run}
        cluster.wait(1.0)
        cluster.finish(f"p{run}")
    kept = {"run --seed=1", "run --seed=3", "run --seed=4"}
    assert set(cluster.intents["learned"]) == kept
    assert set(cluster.state.run_times) == kept


# --- eviction ---------------------------------------------------------------------------------


def full(cluster: Cluster, resource: str) -> None:
    """Have host a over its limit, with an empty host beside it."""
    cluster.wait(2.0)
    source = cluster.machines["a"]
    one = next(one for one in source.resources if one.name == resource)
    cluster.add(host("b", resource, one.accounting, one.capacity))
    source.busy[resource] = 0.9
    cluster.wait(4.0)


def test_the_largest_writer_leaves_a_full_disk() -> None:
    """The measured usage of processes counts also where it is no measure of the readings."""
    disk = host("a", "disk", "shared")
    disk.measured = frozenset({"disk"})
    cluster = Cluster(disk, settle=SETTLE).with_processes(movable("small"), movable("large"))
    disk.shown |= {"small": {"disk": 0.5}, "large": {"disk": 2.0}}
    full(cluster, "disk")
    assert (cluster.where("large"), cluster.where("small")) == (["b"], ["a"])
    assert cluster.recorded("migration_begun") == [
        "large moves from a to b by relaunch: a is over its limit of disk"
    ]


def test_the_process_with_the_largest_declared_need_leaves_where_none_is_measured() -> None:
    """The utilisation of a GPU or a network is not measured for each process."""
    cluster = Cluster(host("a", "network", "shared"), settle=SETTLE)
    cluster.submit(movable("small", needs={"network": 1.0}), movable("none"))
    cluster.submit(movable("large", needs={"network": 3.0}))
    full(cluster, "network")
    assert {name: cluster.where(name) for name in ("small", "large", "none")} == {
        "small": ["a"], "large": ["b"], "none": ["a"]
    }  # fmt: skip


def test_a_resource_that_no_process_accounts_for_is_recorded_once() -> None:
    """New processes that declare no need of it either repeat nothing."""
    cluster = Cluster(host("a", "heat", "shared"), settle=SETTLE).with_processes(movable("p"))
    full(cluster, "heat")
    cluster.set_host("b", "cordon")
    cluster.submit(movable("q"))
    cluster.wait(30.0)
    (said,) = cluster.recorded("nothing_moves")
    assert said == (
        "nothing can leave a: no process on it declares a need of heat, and its use by single "
        "processes is not measured"
    )


# --- usages that cannot be ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("others", "why"),
    [
        ({5: [1.0]}, "slot 5 is not of another resource"),
        ({0: [1.0]}, "slot 0 is not of another resource"),
        ({1: [np.nan]}, "a usage of p#1 was refused"),
        ({1: [-1.0]}, "a usage of p#1 was refused"),
        ({1: [2.0**54]}, "a usage of p#1 was refused"),
    ],
    ids=["unknown slot", "slot of memory", "NaN", "negative", "absurd"],
)
def test_a_usage_that_cannot_be_changes_nothing(others: dict[int, list[float]], why: str) -> None:
    """The master records it, and the reservation stays."""
    cluster = Cluster(host("a", "gpu_memory", "attributed"), settle=SETTLE)
    cluster.submit(running({"gpu_memory": 5.0}))
    machine = cluster.machines["a"]
    one = np.ones(1)
    event = UsagesReceived(
        machine.host_id, machine.incarnation, np.array([1], np.uint64), one, one,
        {slot: np.array(amounts) for slot, amounts in others.items()},
    )  # fmt: skip
    cluster.tell(event)
    assert why in cluster.recorded("reading_refused")[0]
    assert reserved(cluster, "gpu_memory") == pytest.approx(5.0)
