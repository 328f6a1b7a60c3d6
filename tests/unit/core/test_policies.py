"""Third-party scoring policies: their scores apply; broken policies are skipped and named."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rosrm.extensions.contracts import HostView, ProcessView, Scores
from rosrm.extensions.declared_fields import STANDARD_FIELDS
from rosrm.model.values import ResourceDescription
from tests.unit.core.cluster import Cluster, Eq1, Machine, node, process


class Policy:
    """Scoring policy that calls a function of a test."""

    def __init__(self, make: Any) -> None:
        self.make = make
        self.seen: list[HostView] = []

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        self.seen.append(hosts)
        return self.make(hosts, process)


def raises(error: BaseException) -> Any:
    def score(hosts: HostView, process: ProcessView) -> Scores:
        raise error

    return score


def answers(make: Any) -> Any:
    """Return a policy whose answer for n hosts is `make(n)`."""
    return lambda hosts, process: make(len(hosts.names))


def writes(hosts: HostView, process: ProcessView) -> Scores:
    hosts.usage[:] = 0.0
    return Scores(np.zeros(len(hosts.names)))


def reads(field: str, *default: Any) -> Any:
    """Return a policy that reads a field of the spec."""

    def score(hosts: HostView, process: ProcessView) -> Scores:
        return Scores(np.full(len(hosts.names), float(len(getattr(process.spec, field, *default)))))

    return score


def by_name(hosts: HostView, process: ProcessView) -> Scores:
    """Score processes so that each group, by the beginning of the name, has its own host."""
    group = process.spec.name.split("_")[0]
    return Scores(np.array([float(name != group) for name in hosts.names]))


BROKEN = [
    (raises(ZeroDivisionError("oops")), "ZeroDivisionError: oops"),
    (raises(SystemExit(3)), "SystemExit: 3"),
    (answers(lambda n: Scores(np.full(n, np.nan))), "the score of host a is nan"),
    (answers(lambda n: Scores(np.full(n, -np.inf))), "the score of host a is -inf"),
    (answers(lambda n: Scores(np.zeros(1))), "scores of shape (1,) for 3 hosts"),
    (answers(lambda n: 0.5), "answered a float; Scores is required"),
    (answers(lambda n: None), "answered None; Scores is required"),
    (
        answers(lambda n: Scores(["good"] * n)),
        "scores that are no numbers: a list; 3 numbers are required, one for each host",
    ),
    (
        answers(lambda n: Scores(np.zeros(n), np.zeros(1, np.bool_))),
        "vetoes of shape (1,) for 3 hosts",
    ),
    (
        answers(lambda n: Scores(np.zeros(n), ["no"] * n)),
        "vetoes of type <U2; booleans are required, True: vetoed",
    ),
    (
        by_name,
        "'name' of the spec, which its offer does not declare: add reads=('name',) to the offer",
    ),
    (reads("name", ""), "UndeclaredField"),
    (reads("nmae"), "AttributeError: a spec has no field 'nmae'; it has name, node_name"),
    (writes, "read-only"),
]


def three(**fields: Any) -> Cluster:
    """Return a cluster of hosts with different loads: b has the least."""
    hosts = [Machine(n, busy={"memory": m}) for n, m in (("a", 0.5), ("b", 0.2), ("c", 0.4))]
    return Cluster(*hosts, **fields)


def with_gpu_on_b(score: Any, **fields: Any) -> tuple[Cluster, Policy]:
    """Return a cluster where only b has a GPU and a process was placed, and its policy."""
    memory, gpu = ResourceDescription("memory", "B", 1e9), ResourceDescription("gpu", "1", 1.0)
    hosts = Machine("a", resources=(memory,)), Machine("b", resources=(memory, gpu))
    cluster = Cluster(*hosts, policy=(policy := Policy(score)))
    cluster.submit(process("p", **fields))
    return cluster, policy


@pytest.mark.parametrize(
    ("fallback", "host", "decider"),
    [(None, "a", "left out: 'eq1', "), (("weighted", Eq1()), "b", "weighted (left out: 'eq1', ")],
    ids=["no fallback", "fallback"],
)
@pytest.mark.parametrize(("score", "fault"), BROKEN)
def test_a_broken_policy_is_skipped_and_named(
    score: Any, fault: str, fallback: Any, host: str, decider: str
) -> None:
    """The fallback decides, or else any host that fits; decision and record name the failure."""
    cluster = three(policy=Policy(score), fallback=fallback)
    cluster.submit(process("p"))
    assert cluster.where("p") == [host]
    policy = cluster.explain("p")["decision"]["policy"]
    assert policy.startswith(decider)
    assert fault in policy
    (message,) = cluster.recorded("plugin_failed")
    assert message.startswith("the scoring policy 'eq1' fails: score: ")
    assert fault in message


def test_a_policy_that_fails_for_one_host_is_skipped_for_all() -> None:
    """Scores of two policies do not compare, so the fallback scores all hosts."""

    def breaks_when_loaded(hosts: HostView, process: ProcessView) -> Scores:
        if (hosts.processes > 0).any():
            raise RuntimeError("busy")
        return Scores(100.0 + hosts.column("memory"))

    cluster = three(policy=Policy(breaks_when_loaded), fallback=("weighted", Eq1()))
    cluster.submit(process("p", memory=1), process("q", memory=1))
    assert (cluster.where("p"), cluster.where("q")) == (["b"], ["b"])


def test_a_policy_that_failed_decides_again_after_the_next_reading() -> None:
    """A failure skips the policy for one decision only."""
    broken = [True]

    def recovers(hosts: HostView, process: ProcessView) -> Scores:
        if broken[0]:
            raise RuntimeError("not yet")
        return Scores(-hosts.column("memory"))

    cluster = three(policy=Policy(recovers))
    cluster.submit(process("p"))
    broken[0] = False
    cluster.read()
    cluster.submit(process("q"))
    assert cluster.where("q") == ["a"]
    assert cluster.explain("q")["decision"]["policy"] == "eq1"


def test_a_vetoed_host_takes_nothing() -> None:
    """The explanation has the policy's reason."""

    def not_b(hosts: HostView, process: ProcessView) -> Scores:
        veto = np.array([name == "b" for name in hosts.names])
        return Scores(hosts.column("memory"), veto, veto_reason=lambda row: "b is for the boss")

    cluster = three(policy=Policy(not_b))
    cluster.submit(process("p"))
    assert cluster.where("p") == ["c"]
    found = {one["name"]: one for one in cluster.explain("p")["decision"]["hosts"]}
    assert (found["b"]["verdict"], found["b"]["reason"]) == ("vetoed", "b is for the boss")


def test_a_process_that_is_vetoed_everywhere_does_not_wait_for_room() -> None:
    """The reason names the veto as well as the full hosts."""

    def nowhere(hosts: HostView, process: ProcessView) -> Scores:
        return Scores(hosts.column("memory"), np.ones(len(hosts.names), np.bool_))

    cluster = three(policy=Policy(nowhere))
    cluster.submit(process("p"))
    assert cluster.recorded("waits") == ["p waits: no host can take it now"]


def test_a_score_of_a_host_that_does_not_fit_may_be_nan() -> None:
    """A NaN score of a host that lacks the resource is ignored."""
    cluster, _ = with_gpu_on_b(lambda hosts, _: Scores(hosts.usage[:, 1]), needs={"gpu": 0.1})
    assert cluster.where("p") == ["b"]
    assert cluster.explain("p")["decision"]["policy"] == "eq1"


def test_a_reason_that_raises_changes_no_decision() -> None:
    """The error replaces the reason."""

    def shy(hosts: HostView, process: ProcessView) -> Scores:
        return Scores(hosts.column("memory"), reason=lambda row: f"{1 / 0}")

    cluster = three(policy=Policy(shy))
    cluster.submit(process("p"))
    (chosen, *_) = cluster.explain("p")["decision"]["hosts"]
    assert (chosen["name"], chosen["verdict"]) == ("b", "chosen")
    assert "ZeroDivisionError" in chosen["reason"]


@pytest.mark.parametrize("batched", [True, False])
def test_a_policy_scores_by_the_fields_that_it_declares(*, batched: bool) -> None:
    """The policy reads a field that its offer declares, for one process and for batches."""
    cluster = three(policy=Policy(by_name), reads=("name",))
    specs = [process(f"{group}_{n}") for n in range(2) for group in "cab"]
    for batch in [specs] if batched else [[spec] for spec in specs]:
        cluster.submit(*batch)
    assert {spec.name: cluster.where(spec.name) for spec in specs} == {
        spec.name: [spec.name[0]] for spec in specs
    }


def test_declared_values_are_compared_with_their_types() -> None:
    """1, 1.0 and True: declared values are compared as written."""
    seen = []

    def look(hosts: HostView, process: ProcessView) -> Scores:
        seen.append(repr(process.spec.parameters["a"]))
        return Scores(hosts.column("memory"))

    cluster = three(policy=Policy(look), reads=("parameters",))
    cluster.submit(*(node(f"p{n}", parameters={"a": a}) for n, a in enumerate((1, 1.0, True))))
    assert set(seen) == {"1", "1.0", "True"}


def test_processes_that_are_equal_in_all_that_a_policy_reads_share_a_ranking() -> None:
    """Equal processes in the queue are scored once."""
    cluster = three()
    cluster.submit(*(process(f"p{n}") for n in range(5)))
    assert len(cluster.state.demands) == 1


def test_a_policy_may_read_the_standard_fields_undeclared() -> None:
    """Program, namespace, kind, priority, needs and labels need no declaration."""
    read: dict[str, object] = {}

    def look(hosts: HostView, process: ProcessView) -> Scores:
        read.update({name: getattr(process.spec, name) for name in STANDARD_FIELDS})
        read["program"] = process.spec.program
        return Scores(hosts.column("memory"))

    cluster = three(policy=Policy(look))
    spec = process("p", memory=1, priority=3)
    cluster.submit(spec)
    assert cluster.explain("p")["decision"]["policy"] == "eq1"
    assert read == {name: getattr(spec, name) for name in read}


def test_a_policy_sees_the_labels_of_hosts() -> None:
    """The labels are those of the registration, row by row, and read-only."""
    policy = Policy(
        lambda hosts, process: Scores(
            np.array([float(labels.get("rack") != "2") for labels in hosts.labels])
        )
    )
    cluster = Cluster(Machine("a"), Machine("b", labels={"rack": "2"}), policy=policy)
    cluster.submit(process("p"))
    assert cluster.where("p") == ["b"]
    with pytest.raises(TypeError):
        policy.seen[0].labels[0]["rack"] = "1"  # type: ignore[index]


def test_a_column_is_zero_or_a_given_value_where_a_host_has_no_such_resource() -> None:
    """A policy that weighs the GPU also works in a cluster where some hosts have none."""
    cluster, policy = with_gpu_on_b(lambda hosts, _: Scores(hosts.column("gpu", missing=0.5)))
    assert (cluster.where("p"), cluster.explain("p")["decision"]["policy"]) == (["b"], "eq1")
    view = policy.seen[0]
    assert view.column("gpu").tolist() == [0.0, 0.0]
    assert view.column("none", 1.0).tolist() == [1.0, 1.0]


def test_the_cause_of_a_nan_score_is_explained() -> None:
    """The message names the missing resource and the call that avoids the NaN."""
    cluster, _ = with_gpu_on_b(lambda hosts, process: Scores(hosts.usage.sum(axis=1)))
    policy = cluster.explain("p")["decision"]["policy"]
    assert "the score of host a is nan. It does not measure gpu, so `usage` and" in policy


def test_a_policy_sees_nan_where_a_host_has_no_such_resource() -> None:
    """Usage and capacity are NaN and the limit is 1, as `HostView` documents."""
    _, policy = with_gpu_on_b(lambda hosts, process: Scores(hosts.column("memory")))
    view = policy.seen[0]
    assert view.resources == ("memory", "gpu")
    assert np.isnan([view.usage[0, 1], view.capacity[0, 1]]).all()
    assert view.limit[0, 1] == 1.0
    assert list(view.names) == ["a", "b"]
    assert (view.names[0], view.names[-1], view.names[0:1]) == ("a", "b", ["a"])
