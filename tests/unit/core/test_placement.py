"""Placement of the queue's head: score, limits, in-flight load, labels and explanation."""

from __future__ import annotations

import pytest

from rosrm.core.master import events as happened
from rosrm.model.values import ResourceDescription
from tests.unit.core.cluster import GIB, MIB, Cluster, Eq1, Machine, job, process


def machine(name: str, memory: float = 0.1, cpu: float = 0.1, **fields: object) -> Machine:
    return Machine(name, busy={"memory": memory, "cpu": cpu}, **fields)


def test_the_host_with_the_largest_margin_is_chosen() -> None:
    """Eq. 1 prefers the lowest weighted usage."""
    cluster = Cluster(machine("a", memory=0.5), machine("b", memory=0.2), machine("c", memory=0.3))
    cluster.submit(process("p"))
    assert cluster.where("p") == ["b"]


def test_the_weights_of_eq_1_decide() -> None:
    """With the whole weight on CPU, memory has no effect."""
    hosts = machine("a", memory=0.1, cpu=0.5), machine("b", memory=0.5, cpu=0.1)
    cluster = Cluster(*hosts, policy=Eq1(memory=0.0, cpu=1.0)).with_processes(process("p"))
    assert cluster.where("p") == ["b"]


def test_equal_scores_go_to_the_host_with_fewer_processes_then_to_the_first() -> None:
    """A tie is broken by the number of processes, then by the order of registration."""
    cluster = Cluster("a", "b", policy=Eq1(memory=0.0))
    for name in "pqr":
        cluster.submit(process(name))
    assert [cluster.where(name) for name in "pqr"] == [["a"], ["b"], ["a"]]


def test_placement_waits_for_the_first_request_of_a_new_host(monkeypatch) -> None:
    """Placement waits for the host's first request, and the reason names that wait."""
    cluster = Cluster("a")
    with monkeypatch.context() as patched:
        patched.setattr(cluster, "ask_for_work", lambda machine: None)
        cluster.add("b")
    cluster.submit(process("p"), process("q"))
    assert cluster["p"].reason == ("waits for the first request for work of b, registered just now")
    cluster.wait(0.1)
    assert cluster.counts() == {"a": 1, "b": 1}
    assert cluster.recorded("waits") == []


def test_hosts_that_never_request_work_delay_placement_by_a_second(monkeypatch) -> None:
    """Placement waits 1 s at most, though another host registers every 0.4 s."""
    cluster = Cluster("a")
    monkeypatch.setattr(cluster, "ask_for_work", lambda machine: None)
    for number in range(4):
        cluster.add(f"b{number}")
        if not number:
            cluster.submit(process("p"))
        assert not cluster.where("p") or number == 3
        cluster.wait(0.4)
    assert cluster.where("p") == ["a"]


@pytest.mark.parametrize("needs", ["declared", "default", "learned"])
def test_sixty_equal_processes_on_three_equal_hosts_end_20_20_20(needs: str) -> None:
    """A new assignment counts before readings show it, with declared, learned or unknown needs."""
    cluster = Cluster("a", "b", "c")
    if needs == "learned":
        cluster.machines["a"].shown["first"] = {"memory": 90 * MIB}
        cluster.submit(job("first"))
        cluster.finish("first")
        assert cluster["first"].phase.value == "finished"
    memory = 80.0 if needs == "declared" else 0.0
    cluster.submit(*[process(f"p{i}", memory=memory) for i in range(60)])
    assert cluster.counts() == {"a": 20, "b": 20, "c": 20}


@pytest.mark.parametrize(
    ("used", "run_time", "need"),
    [
        ({"memory": 160 * MIB, "cpu": 0.5}, 10.0, {"memory": 160 * MIB, "cpu": 0.5}),
        ({"memory": 2 * MIB, "cpu": 1.0}, 0.01, {"memory": 2 * MIB, "cpu": 0.1}),
    ],
    ids=["long run", "short run"],
)
def test_learned_needs_replace_needs_that_were_not_declared(
    used: dict[str, float], run_time: float, need: dict[str, float]
) -> None:
    """The peak of an earlier run of the same program counts against the host.

    CPU is not learned from a short run. The start of `true` looks like a whole core, and must not
    exclude such processes from small hosts.
    """
    cluster = Cluster("a").with_processes(job("first"))
    cluster.machines["a"].shown["first"] = used
    cluster.finish("first", run_time=run_time)
    cluster.submit(process("second"))
    assert cluster.explain("second")["decision"]["need"] == need


def test_estimates_are_capped_and_declared_needs_are_not() -> None:
    """An estimate fills at most half of a limit, so that it excludes no process from every host."""
    cluster = Cluster(Machine("tiny", memory=64 * MIB, cpu=0.1)).with_processes(process("guessed"))
    assert cluster.where("guessed") == ["tiny"]
    cluster.submit(process("declared", memory=64))
    assert cluster.phase("declared") == "set_aside"


def test_a_resource_that_a_host_lacks_excludes_declared_needs_and_not_estimates() -> None:
    """A process that needs a GPU never goes to a host without one.

    A host that probes memory only still takes processes with an estimated CPU need. The free room
    of a host without memory is unknown.
    """
    memory, gpu = ResourceDescription("memory", "B", GIB), ResourceDescription("gpu", "1", 1)
    cluster = Cluster(Machine("d", resources=(ResourceDescription("disk", "B", GIB),)))
    cluster.submit(process("r", memory=1))
    assert cluster.phase("r") == "set_aside"
    cluster.add(Machine("a", resources=(memory,)))
    assert cluster.where("r") == ["a"]
    cluster.set_host("d", "cordon")
    cluster.submit(process("p"), process("q", needs={"gpu": 0.5}))
    assert cluster.where("p") == ["a"]
    assert cluster.phase("q") == "set_aside"
    assert "no host reports the resource 'gpu'" in cluster["q"].reason
    cluster.add(Machine("g", resources=(memory, gpu)))
    assert cluster.where("q") == ["g"]


def test_nothing_is_assigned_over_a_limit() -> None:
    """Reading, in-flight load and needs together stay under every limit."""
    cluster = Cluster(Machine("a", memory=1000 * MIB, busy={"memory": 0.3}))
    cluster.submit(*[process(f"p{i}", memory=100) for i in range(9)])
    assert cluster.counts() == {"a": 5}  # 0.3 + 5 x 0.1 = 0.8
    assert cluster.queue() == ["p5", "p6", "p7", "p8"]


def test_a_host_without_a_reading_gets_no_work(monkeypatch) -> None:
    """Usage and limits of a host are unknown until its first reading."""
    cluster = Cluster()
    with monkeypatch.context() as silent:
        silent.setattr(cluster, "read", lambda *machines: None)
        cluster.add(machine("a"))
        cluster.submit(process("p"))
    assert cluster.phase("p") == "queued"
    cluster.read()
    cluster.settle()
    assert cluster.where("p") == ["a"]


def test_max_processes_limits_the_processes_of_a_host() -> None:
    """A slot is taken from the assignment to the end."""
    cluster = Cluster(Machine("a", max_processes=2), Machine("b", max_processes=1))
    cluster.submit(*[job(f"p{i}") for i in range(5)])
    assert cluster.counts() == {"a": 2, "b": 1}
    cluster.finish("p1", "b")
    assert cluster.where("p3") == ["b"]
    assert cluster.queue() == ["p4"]


# --- in-flight load ---------------------------------------------------------------------------


def load(cluster: Cluster, host: str) -> float:
    state = cluster.state
    return float(state.hosts.load[0, state.hosts.by_name[host].column]) * 1000


def test_a_reservation_falls_as_usage_shows_and_ends_with_its_instance() -> None:
    """A process counts once, not both in flight and in the reading."""
    cluster = Cluster(Machine("a", memory=1000 * MIB)).with_processes(job("p", memory=100))
    for used in (0, 60, 150, 0):
        cluster.machines["a"].shown["p"] = {"memory": used * MIB}
        cluster.wait(0.1)
        assert load(cluster, "a") == pytest.approx(max(0, 100 - used))
    cluster.finish("p")
    assert load(cluster, "a") == 0.0


def test_a_reserved_estimate_expires_and_a_declared_need_stays() -> None:
    """After `settle` the reading replaces an estimate; a larger declared need stays reserved."""
    cluster = Cluster(Machine("a", memory=1000 * MIB), settle=10.0)
    cluster.submit(process("guessed"), process("declared", memory=100))
    assert load(cluster, "a") == pytest.approx(164)
    cluster.wait(9.0)
    assert load(cluster, "a") == pytest.approx(164)
    cluster.wait(2.0)
    assert load(cluster, "a") == pytest.approx(100)


# --- labels -----------------------------------------------------------------------------------


def test_required_labels_select_the_hosts() -> None:
    """The load of the matching hosts makes no difference."""
    hosts = machine("a"), machine("b", memory=0.7, labels={"lidar": "front"})
    cluster = Cluster(*hosts).with_processes(process("driver", required_labels={"lidar": "front"}))
    assert cluster.where("driver") == ["b"]


def test_preferred_labels_precede_the_margin() -> None:
    """Among hosts that fit, those with more of the preferred labels come first."""
    both = {"ssd": "yes", "fast": "yes"}
    hosts = [
        machine("a"), machine("b", memory=0.4, labels={"ssd": "yes"}),
        machine("c", memory=0.6, labels=both),
    ]  # fmt: skip
    cluster = Cluster(*hosts).with_processes(process("p", preferred_labels=both))
    assert cluster.where("p") == ["c"]


def test_a_host_with_avoided_labels_is_the_last_choice() -> None:
    """A host with avoided labels is better than none."""
    hosts = machine("a", labels={"battery": "yes"}), machine("b", memory=0.7)
    cluster = Cluster(*hosts).with_processes(process("p", avoided_labels={"battery": "yes"}))
    assert cluster.where("p") == ["b"]
    cluster.machines["b"].busy["memory"] = 0.9
    cluster.read()
    cluster.submit(process("q", avoided_labels={"battery": "yes"}))
    assert cluster.where("q") == ["a"]


# --- explain ----------------------------------------------------------------------------------


def test_an_explanation_has_the_score_or_reason_of_each_host() -> None:
    """The explanation has the chosen host with its score, and a reason for each other host."""
    hosts = [
        machine("full", memory=0.79), machine("good", memory=0.2), machine("fair", memory=0.3),
        machine("closed"), machine("other", labels={"arch": "arm"}),
    ]  # fmt: skip
    cluster = Cluster(*hosts)
    cluster.set_host("closed", "cordon")
    cluster.machines["other"].busy["memory"] = 0.95
    cluster.read()
    cluster.submit(process("p", memory=1024))
    story = cluster.explain("p")
    decision = story["decision"]
    assert (story["state"], story["host"], decision["chosen"]) == ("running", "good", "good")
    found = {one["name"]: (one["verdict"], one["reason"]) for one in decision["hosts"]}
    assert found["good"] == ("chosen", "0.200 by Eq. 1")
    assert found["fair"] == ("fits", "0.300 by Eq. 1")
    assert found["full"] == (
        "full", "memory: needs 1.1 GB; at most 13.7 GB (80%) may be used: 13.6 GB in use",
    )  # fmt: skip
    assert found["closed"] == ("excluded", "it is cordoned")
    assert found["other"] == ("excluded", "it is over its limit of memory")
    assert decision["hosts"][0]["name"] == "good"


def test_later_readings_do_not_change_an_explanation() -> None:
    """Later readings do not change the recorded decision."""
    cluster = Cluster(machine("a", memory=0.2), machine("b", memory=0.3))
    commands = cluster.decide(happened.SubmissionReceived(1, (process("p"),)))
    (record,) = [c for c in commands if getattr(c, "kind", "") == "assigned"]
    cluster.machines["a"].busy["memory"] = 0.7
    cluster.read()
    scores = [host["score"] for host in record.facts["decision"]["hosts"]]
    assert scores == pytest.approx([0.2, 0.3])


def test_an_explanation_names_the_best_hosts_and_counts_the_others() -> None:
    """A record in a cluster of a thousand hosts stays short."""
    cluster = Cluster(*[machine(f"h{i}", memory=0.01 * i) for i in range(40)])
    cluster.set_host("h39", "cordon")
    cluster.submit(process("p"))
    decision = cluster.explain("p")["decision"]
    assert [host["name"] for host in decision["hosts"]] == ["h0", "h1", "h2", "h3"]
    assert decision["omitted"] == {"would take it at a higher score": 35, "cannot take it now": 1}


def test_the_explanation_of_a_waiting_process_names_the_head_of_the_queue() -> None:
    """`explain` of a queued process names the head of the queue."""
    cluster = Cluster().with_processes(process("p"), process("q"))
    assert cluster.explain("p")["reason"] == "no host has registered yet"
    assert "1 before it in the queue, p first" in cluster.explain("q")["reason"]
