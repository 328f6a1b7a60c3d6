"""Ended processes and departed hosts are removed from the listings."""

from __future__ import annotations

from rosrm.core import events as happened
from rosrm.core import listing
from rosrm.core.commands import Reply
from tests.unit.core.cluster import Cluster, job, process


def prune(cluster: Cluster, *names: str, hosts: tuple[str, ...] = ()) -> Reply:
    return cluster.ask(happened.PruneRequested, names, hosts, "anna@desk")


def seen(cluster: Cluster) -> tuple[list[str], list[str]]:
    """Names of the processes and hosts that are listed."""
    processes = listing.process_rows(cluster.state, cluster.now)
    hosts = listing.host_rows(cluster.state, cluster.now)
    return [row.name for row in processes], [row.description.name for row in hosts]


def of_two_hosts() -> Cluster:
    """Host b has left; of three processes one has finished, one was cancelled, one runs."""
    cluster = Cluster("a")
    cluster.submit(job("done"), process("gone"), process("live"))
    cluster.machines["a"].finish("done", cluster.now)
    cluster.add("b")
    cluster.cancel("gone")
    cluster.leave(cluster.machines["b"])
    cluster.machines["b"].connected = False
    cluster.wait(1.0)
    assert seen(cluster) == (["done", "gone", "live"], ["a", "b"])
    return cluster


def test_without_names_all_that_ended_and_all_hosts_that_left_are_removed() -> None:
    """From the journal too."""
    cluster = of_two_hosts()
    assert prune(cluster).message == "2 processes and 1 host removed"
    assert seen(cluster) == (["live"], ["a"])
    cluster.submit(process("next"))
    assert [row["name"] for row in cluster.explain("next")["decision"]["hosts"]] == ["a"]
    cluster.cancel("next")
    prune(cluster, "next")
    cluster.restart_master()
    assert seen(cluster) == (["live"], ["a"])
    assert prune(cluster).message == "0 processes and 0 hosts removed"


def test_a_pruned_host_that_registers_is_listed_and_given_work() -> None:
    """As a new one; a master that was restarted knows it."""
    cluster = of_two_hosts()
    prune(cluster)
    assert "no such host: 'b'; there are: a" in cluster.set_host("b", "cordon").message
    machine = cluster.machines["b"]
    machine.connected = True
    cluster.register(machine)
    cluster.set_host("a", "cordon")
    cluster.submit(process("more"))
    assert (seen(cluster)[1], cluster.where("more")) == (["a", "b"], ["b"])
    cluster.kill_master()
    assert seen(cluster)[1] == ["a", "b"]


def test_what_has_not_ended_or_left_is_refused_and_nothing_is_removed() -> None:
    """By name, of processes and hosts."""
    cluster = of_two_hosts()
    refused = prune(cluster, "done", "live")
    assert refused.message == "live is running; cancel it first. Nothing was removed"
    assert "no such process: ghost" in prune(cluster, "ghost").message
    assert "a is up; stop its slave first" in prune(cluster, hosts=("a",)).message
    assert "no such host: 'c'" in prune(cluster, hosts=("c",)).message
    assert seen(cluster) == (["done", "gone", "live"], ["a", "b"])


def test_a_lost_host_is_pruned_once_all_that_it_may_run_was_cancelled() -> None:
    """Then they are cancelled; if the host returns after all, they are stopped there."""
    cluster = Cluster("a")
    cluster.submit(process("p"))
    cluster.machines["a"].connected = False
    cluster.wait(12.0)
    refused = prune(cluster, hosts=("a",))
    assert refused.message == "a may still run p; cancel it first. Nothing was removed"
    cluster.cancel("p")
    assert prune(cluster, hosts=("a",)).accepted
    assert (cluster.phase("p"), seen(cluster)[1]) == ("cancelled", [])
    assert cluster.told("host_pruned") == ["a was removed (by anna@desk)"]
    cluster.machines["a"].connected = True
    cluster.wait(1.0)
    assert seen(cluster)[1] == []
    cluster.register(cluster.machines["a"])
    cluster.wait(1.0)
    assert (cluster.where("p"), seen(cluster)[1]) == ([], ["a"])
