"""Removal of ended processes and departed hosts from the listings."""

from __future__ import annotations

from rosrm.core.master import events as happened
from rosrm.core.master import listing
from rosrm.core.master.commands import Reply
from rosrm.model.requester import Requester
from tests.unit.core.cluster import Cluster, job, process


def prune(cluster: Cluster, *names: str, hosts: tuple[str, ...] = ()) -> Reply:
    by = Requester("anna@desk", is_operator=True)
    return cluster.ask(happened.PruneRequested, names, hosts, by)


def seen(cluster: Cluster) -> tuple[list[str], list[str]]:
    """Return the names of the listed processes and hosts."""
    processes = listing.process_rows(cluster.state, cluster.now)
    hosts = listing.host_rows(cluster.state, cluster.now)
    return [row.name for row in processes], [row.description.name for row in hosts]


def of_two_hosts() -> Cluster:
    """Return a cluster: host b has left; one process finished, one was cancelled, one runs."""
    cluster = Cluster("a").with_processes(job("done"), process("gone"), process("live"))
    cluster.machines["a"].finish("done", cluster.now)
    cluster.add("b")
    cluster.cancel("gone")
    cluster.leave("b")
    cluster.cut("b", seconds=1.0)
    assert seen(cluster) == (["done", "gone", "live"], ["a", "b"])
    return cluster


def test_without_names_all_ended_processes_and_departed_hosts_are_removed() -> None:
    """They are removed from the journal, too."""
    cluster = of_two_hosts()
    assert prune(cluster).message == "2 processes and 1 host removed"
    assert seen(cluster) == (["live"], ["a"])
    cluster.submit(process("next"))
    assert [row["name"] for row in cluster.explain("next")["decision"]["hosts"]] == ["a"]
    cluster.cancel("next")
    prune(cluster, "next")
    cluster.restart_master()
    assert seen(cluster) == (["live"], ["a"])
    assert prune(cluster).message == "nothing to remove"


def test_a_process_that_every_listed_host_refused_fails() -> None:
    """A pruned host no longer counts as a possible host."""
    cluster = of_two_hosts()
    prune(cluster)
    cluster.machines["a"].refuses["next"] = "no such package"
    cluster.submit(process("next"))
    cluster.wait(1.0)
    assert cluster.phase("next") == "failed"


def test_a_pruned_host_that_registers_is_listed_and_given_work() -> None:
    """The host is listed as a new one, by a restarted master, too."""
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


def test_a_pruned_host_registers_as_a_new_host() -> None:
    """The new host is open for work, though the old one was cordoned and draining."""
    cluster = of_two_hosts()
    cluster.set_host("b", "cordon")
    cluster.set_host("b", "drain")
    cluster.wait(1.0)
    drained = cluster.recorded("host_drained")
    host = cluster.state.hosts.by_name["b"]
    for known in (host.over_at, host.over_since, host.exceeded_since):
        known["memory"] = cluster.now
    prune(cluster, hosts=("b",))
    cluster.wait(20.0)
    assert (cluster.recorded("host_drained"), cluster.recorded("under_limit")) == (drained, [])
    machine = cluster.machines["b"]
    machine.connected = True
    cluster.register(machine)
    (_, row) = listing.host_rows(cluster.state, cluster.now)
    assert (row.state, host.cordoned, host.draining) == ("up", False, False)
    cluster.set_host("a", "cordon")
    cluster.submit(process("more"))
    assert cluster.where("more") == ["b"]


def test_no_reason_names_a_pruned_host() -> None:
    """Reasons are correct with another host in the listing, and without any."""
    cluster = of_two_hosts()
    prune(cluster, hosts=("b",))
    cluster.set_host("a", "cordon")
    cluster.submit(process("p"))
    assert cluster["p"].reason == "every host is away: a is cordoned"
    cluster.cancel("p", "live")
    cluster.leave("a")
    cluster.cut("a", seconds=1.0)
    prune(cluster)
    cluster.submit(process("q"))
    cluster.wait(1.0)
    assert cluster["q"].reason == "no host has registered yet"


def test_an_explanation_does_not_count_a_pruned_host() -> None:
    """The host is neither named nor counted among the hosts left out."""
    cluster = Cluster(*(f"h{number}" for number in range(20)))
    for number in range(18):
        cluster.set_host(f"h{number}", "cordon")
    for name in ("h0", "h18", "h19"):
        cluster.leave(name)
        cluster.machines[name].connected = False
    prune(cluster)
    cluster.submit(process("p"))
    decision = cluster.explain("p")["decision"]
    assert "h0" not in [row["name"] for row in decision["hosts"]]
    assert sum(decision["omitted"].values()) + len(decision["hosts"]) == 17


def test_a_running_process_or_host_refuses_the_prune() -> None:
    """The refusal names such processes and hosts."""
    cluster = of_two_hosts()
    refused = prune(cluster, "done", "live")
    assert refused.message == "live is running; cancel it first. Nothing was removed"
    assert "no such process: 'ghost'" in prune(cluster, "ghost").message
    assert "a is up; stop its slave first" in prune(cluster, hosts=("a",)).message
    assert "no such host: 'c'" in prune(cluster, hosts=("c",)).message
    assert seen(cluster) == (["done", "gone", "live"], ["a", "b"])


def test_a_suspect_host_is_refused_as_suspect() -> None:
    """The refusal names its silence and the time of its loss; after the loss it is pruned."""
    cluster = Cluster("a")
    cluster.cut("a", seconds=3.0)
    assert prune(cluster, hosts=("a",)).message == (
        "a is suspect: it has not reported for 3.0 s and may report again. Stop its slave if it "
        "runs; a host can be pruned once it has left or is lost, which is after 10 s of silence. "
        "Nothing was removed"
    )
    cluster.wait(8.0)
    assert prune(cluster, hosts=("a",)).accepted


def test_a_leaving_host_is_not_pruned_before_its_processes_have_ended() -> None:
    """Its slave still stops the processes; the user has to wait, and need not cancel."""
    cluster = Cluster("a").with_processes(process("p"))
    machine = cluster.machines["a"]
    cluster.tell(happened.HostLeft(99, machine.host_id, machine.incarnation))
    assert prune(cluster, hosts=("a",)).message == (
        "a is still stopping p; wait until it has ended. Nothing was removed"
    )


def test_a_lost_host_is_pruned_once_its_processes_are_cancelled() -> None:
    """The processes are then cancelled; if the host returns, they are stopped there."""
    cluster = Cluster("a").with_processes(process("p"))
    cluster.cut("a", seconds=12.0)
    refused = prune(cluster, hosts=("a",))
    assert refused.message == "a may still run p; cancel it first. Nothing was removed"
    cluster.cancel("p")
    assert prune(cluster, hosts=("a",)).message == (
        "1 host removed; p may still run on a: `rosrm slave --stop-all` on that host stops it"
    )
    assert (cluster.phase("p"), seen(cluster)[1]) == ("cancelled", [])
    assert cluster["p"].reason == "it may still run on a, which was removed"
    assert cluster.recorded("host_pruned") == ["a was removed (by anna@desk)"]
    cluster.reconnect("a", seconds=1.0)
    assert seen(cluster)[1] == []
    cluster.register(cluster.machines["a"])
    cluster.wait(1.0)
    assert (cluster.where("p"), seen(cluster)[1], cluster["p"].reason) == ([], ["a"], "")


def test_the_prune_names_each_process_that_the_host_may_still_run() -> None:
    """Refusal and reply name each process, because a detached host keeps running cancelled ones."""
    cluster = Cluster("a").with_processes(process("p"), process("q"))
    cluster.detach("a")
    refused = prune(cluster, hosts=("a",))
    assert refused.message == "a may still run p and q; cancel them first. Nothing was removed"
    cluster.cancel("p", "q")
    assert prune(cluster, hosts=("a",)).message == (
        "1 host removed; p and q may still run on a: `rosrm slave --stop-all` on that host stops "
        "them"
    )
    assert cluster["q"].reason == "it may still run on a, which was removed"
