"""Limits and scheduling of processes: hosts that can enforce them, refusals, listings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from rosrm.core.master import listing
from rosrm.core.supervisor.instance import killed_for_memory
from rosrm.model.limits import limits_fault
from rosrm.model.values import HostDescription, Limits, ProcessSpec, Realtime
from tests.unit.core.cluster import MIB, Cluster, Machine, process

NAN = float("nan")
NO_GROUPS = {"limits.memory": "nothing is delegated", "limits.cpu": "nothing is delegated"}


@dataclass(kw_only=True)
class Partial(Machine):
    """Simulated host that cannot enforce some settings, and has some CPUs."""

    unenforced: Mapping[str, str] = field(default_factory=dict)
    cpus: tuple[int, ...] = ()

    def description(self) -> HostDescription:
        described = super().description()
        return replace(described, unenforced=self.unenforced, cpus=self.cpus)


def limited(name: str, **limits: Any) -> ProcessSpec:
    """Return the spec of a process with limits."""
    return process(name, limits=Limits(**limits))


def why_not(cluster: Cluster, name: str) -> Mapping[str, str]:
    """Return host to the reason why it does not take a process."""
    hosts = cluster.explain(name)["decision"]["hosts"]
    return {one["name"]: one["reason"] for one in hosts if one["verdict"] == "excluded"}


def test_required_limits_select_the_hosts_that_can_enforce_them() -> None:
    """Other settings that a host cannot enforce make no difference."""
    cluster = Cluster(Partial("a", unenforced=NO_GROUPS), Partial("b", unenforced={"nice": "-"}))
    cluster.submit(limited("p", memory=5e8, enforce="required"))
    assert cluster.where("p") == ["b"]
    assert why_not(cluster, "p") == {"a": "it cannot enforce limits.memory: nothing is delegated"}


def test_limits_that_are_not_required_select_no_host() -> None:
    """A host that cannot enforce them runs the process without."""
    cluster = Cluster(Partial("a", unenforced=NO_GROUPS)).with_processes(limited("p", memory=5e8))
    assert cluster.where("p") == ["a"]
    assert cluster.explain("p")["limits"] == {
        "limits.memory": {"value": "500 MB", "holds": False, "reason": "nothing is delegated"}
    }


def test_required_limits_that_no_host_can_enforce_set_a_process_aside() -> None:
    """The process is placed as soon as a host registers that can enforce them."""
    required = Limits(memory=5e8, cpu=1.5, enforce="required")
    cluster = Cluster(Partial("a", unenforced=NO_GROUPS))
    cluster.submit(process("p", limits=required), process("q"))
    assert (cluster["p"].phase.value, cluster.where("q")) == ("set_aside", ["a"])
    reason = "it cannot enforce limits.memory and limits.cpu: nothing is delegated"
    assert why_not(cluster, "p") == {"a": reason}
    cluster.add(Partial("b"))
    cluster.wait(2.0)
    assert cluster.where("p") == ["b"]


@pytest.mark.parametrize(
    "other", [{"enforce": "required"}, {"arguments": ("--fast",)}], ids=lambda one: next(iter(one))
)
def test_limits_of_an_application_change_with_a_new_start_where_they_must(
    other: dict[str, Any],
) -> None:
    """Its host cannot enforce them and they are required, or the arguments change, too."""
    cluster = Cluster(Partial("a", unenforced=NO_GROUPS), Partial("b", busy={"memory": 0.5}))
    cluster.apply("nav", limited("p", memory=1e9))
    cluster.wait(1.0)
    assert cluster.where("p") == ["a"]
    enforce = {"enforce": other.pop("enforce")} if "enforce" in other else {}
    changed = replace(limited("p", memory=5e8, **enforce), **other)
    assert [one.action.value for one in cluster.apply("nav", changed).actions] == ["replace"]
    cluster.wait(5.0)
    assert cluster.where("p") == (["b"] if enforce else ["a"])


def test_cpus_select_the_hosts_that_have_them() -> None:
    """A host of an earlier version may have them; its supervisor refuses what it cannot do."""
    cluster = Cluster(Partial("a", cpus=(0, 1, 2)), Partial("b", cpus=(2, 3, 7)))
    cluster.submit(process("p", cpus=(2, 3)))
    assert cluster.where("p") == ["b"]
    assert why_not(cluster, "p") == {"a": "it has no CPU 3; it has 0, 1 and 2"}
    assert Cluster("c").with_processes(process("p", cpus=(2, 3))).where("p") == ["c"]


def test_listings_show_the_limits_that_hold() -> None:
    """A limit that its slave does not report as enforced is not shown."""
    spec = process("p", limits=Limits(memory=512e6, cpu=1.5), cpus=(0, 1), nice=-5)
    cluster = Cluster("a").with_processes(spec)
    (instance,) = cluster.state.instances.values()
    instance.enforced = ("limits.memory", "cpus")
    row = listing.process_row(cluster.state, cluster["p"], cluster.now)
    assert (row.memory_limit, row.cpu_limit) == (512_000_000, 0.0)
    limits = cluster.explain("p")["limits"]
    assert {name: (one["value"], one["holds"]) for name, one in limits.items()} == {
        "limits.memory": ("512 MB", True), "limits.cpu": ("1.5 cores", False),
        "cpus": ("0, 1", True), "nice": ("-5", False),
    }  # fmt: skip


def test_an_explanation_names_a_limit_below_the_usage_of_earlier_runs() -> None:
    """The next run will probably be killed."""
    cluster = Cluster("a")
    cluster.state.learned.restore("run it", {"memory": 6e8, "cpu": 0.1})
    cluster.submit(limited("p", memory=5e8, cpu=1.0))
    limits = cluster.explain("p")["limits"]
    assert (limits["limits.memory"]["used"], "used" in limits["limits.cpu"]) == ("600 MB", False)


@pytest.mark.parametrize(
    ("fields", "fault"),
    [
        ({"limits": Limits(memory=NAN)}, "limits.memory is ?; allowed: 0 (no limit), or 4.0 MB to"),
        ({"limits": Limits(memory=1e3)}, "limits.memory is 1.0 kB; allowed: "),
        ({"limits": Limits(memory_high=-1e9)}, "limits.memory_high is -1.0 GB; allowed: "),
        ({"limits": Limits(cpu=1e-3)}, "limits.cpu is 0.001 cores; allowed: 0 (no limit), or 0.01"),
        ({"limits": Limits(cpu=float("inf"))}, "limits.cpu is ?; allowed: "),
        ({"limits": Limits(memory=1e8, memory_high=2e8)}, "limits.memory_high must not be more"),
        ({"limits": Limits(enforce="perhaps")}, "limits.enforce 'perhaps'; allowed: preferred, "),
        ({"limits": Limits(memory=1e8), "needs": {"memory": 2e8}},
         "limits.memory is 100 MB, less than needs.memory, 200 MB"),
        ({"cpus": (-1,)}, "cpus: -1 is no number of a CPU; allowed: 0 to 65535"),
        ({"cpus": (1, 1)}, "cpus: a CPU is given twice"),
        ({"realtime": Realtime("idle", 1)}, "realtime.policy 'idle'; allowed: fifo, rr"),
        ({"realtime": Realtime("fifo", 0)}, "realtime.priority is 0; allowed with a policy: 1 to"),
        ({"realtime": Realtime("rr", 100)}, "realtime.priority is 100; allowed with a policy: "),
        ({"realtime": Realtime("", 7)}, "realtime.priority is 7; allowed with a policy: "),
        ({"nice": 20}, "nice is 20; allowed: -20 to 19"),
        ({"realtime": Realtime("rr", 1), "nice": 1}, "nice has no effect on a process with `rea"),
        ({"realtime": Realtime("rr", 1), "limits": Limits(cpu=1.0)}, "limits.cpu has no effect on"),
    ],
)  # fmt: skip
def test_limits_that_make_no_sense_have_a_fault(fields: Any, fault: str) -> None:
    """The fault names the key, the value and the allowed ones."""
    assert limits_fault(process("p", **fields)).startswith(fault)


def test_limits_below_the_needs_are_refused_at_submission() -> None:
    """Also if one of both is a default of the cluster, which the refusal names."""
    defaults = process("", limits=Limits(memory=1e8), given=("limits.memory",))
    reply = Cluster("a", process_defaults=defaults).submit(process("p", memory=1000))
    assert not reply.accepted
    assert f"less than needs.memory, {1000 * MIB / 1e9:.1f} GB" in reply.message
    assert "(limits.memory is given by `defaults.process` of the cluster)" in reply.message


def test_an_end_by_the_oom_killer_is_reported_as_what_it_is() -> None:
    """An instance below its limit was killed because its host ran out of memory."""
    assert killed_for_memory(512e6, 500e6) == "killed: used 512 MB of 500 MB"
    out = "killed: its host ran out of memory; it used 200 MB"
    assert killed_for_memory(200e6, 500e6) == f"{out} of 500 MB"
    assert killed_for_memory(200e6, 0.0) == out
