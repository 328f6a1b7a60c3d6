"""Placement: the largest margin, first in first out, never over a limit."""

from __future__ import annotations

import re
import time
from collections import Counter
from dataclasses import replace

import pytest

from rosrm.config.settings import ProcessDefaults, QueueSettings, ScoringChoice
from rosrm.ros import names, qos
from rosrm.ros.participant import Participant
from rosrm_msgs import srv
from tests.ros.clusters import MIB, STEADY, host, job, python, service
from tests.waiting import PATIENCE, wait_until

HOLD = """
import mmap, sys, time
held = mmap.mmap(-1, int(sys.argv[1]))
for at in range(0, len(held), 4096): held[at] = 1
print("held", flush=True)
time.sleep(1000)
"""


def holder(name: str, mib: int, **options):
    """Return a process that uses `mib` MiB of memory."""
    options.setdefault("needs", {"memory": (mib + 10.0) * MIB, "cpu": 0.0})
    spec = python(name, HOLD, **options)
    return replace(spec, arguments=(str(mib * MIB),))


def memory(cluster) -> list:
    """Return the memory of each host."""
    rows = cluster.client.list(hosts=True).hosts
    return [one for row in rows for one in row.resources if one.name == "memory"]


def on(view, name: str) -> int:
    return sum(row.host == name and row.state == "running" for row in view.processes)


def test_sixty_equal_processes_are_spread_evenly(make_cluster) -> None:
    """Three equal hosts get 20 of 60 simultaneously submitted processes each, give or take one."""
    hosts = [host(f"h{n}", memory=4096 * MIB) for n in range(3)]
    cluster = make_cluster(*hosts, liveness=STEADY)
    specs = [service(f"p{n:02}") for n in range(60)]

    cluster.submit(*specs)
    view = cluster.wait_until(
        "60 running", lambda v: sum(r.state == "running" for r in v.processes) == 60
    )

    counts = Counter(row.host for row in view.processes)
    assert set(counts) == {"h0", "h1", "h2"}
    assert max(counts.values()) - min(counts.values()) <= 2, counts
    assert all(19 <= count <= 21 for count in counts.values()), counts
    assert all("assigned" in cluster.kinds(name) for name in ("p00", "p59"))
    cluster.client.cancel([spec.name for spec in specs])


@pytest.fixture(scope="module")
def narrow(make_shared):
    """Yield a cluster with one host for one process at a time."""
    return make_shared(
        host("narrow", max_processes=1), defaults=ProcessDefaults(needs={"memory": MIB})
    )


def test_first_in_first_out(narrow) -> None:
    """Processes start in order of submission; a higher priority goes first."""
    narrow.submit(service("blocker"))
    narrow.wait("blocker", "running")
    narrow.submit(job("a", "true"), job("b", "true"), job("c", "true"))
    narrow.submit(job("urgent", "true", priority=5), job("d", "true"))
    waiting = {r.name: r.queue_position for r in narrow.client.list(processes=True).processes}
    assert [waiting[name] for name in ("urgent", "a", "b", "c", "d")] == [1, 2, 3, 4, 5]
    narrow.cancel("blocker")
    for name in ("urgent", "a", "b", "c", "d"):
        narrow.ended(name)
    order = [event.process for event in narrow.events("assigned") if event.process != "blocker"]
    assert order == ["urgent", "a", "b", "c", "d"]


def test_no_more_processes_than_allowed(narrow) -> None:
    """`max_processes` holds at every moment."""
    folder = narrow.directory / "at-work"
    folder.mkdir()
    script = f"touch {folder}/$$; ls {folder} | wc -l; rm {folder}/$$"
    specs = [job(f"slot{n}", "sh", "-c", script) for n in range(20)]
    for row in narrow.run(*specs):
        assert row.state == "finished"
        assert narrow.log(row.name).strip() == "1"


def test_an_idle_cluster_is_quiet(narrow) -> None:
    """The slave keeps one request for work open, and sends no other while there is none."""
    with Participant(narrow.ros, "rosrm_test_counter") as participant:
        seen = []
        path = names.Names("/rosrm")(names.REQUEST_PROCESS)
        # Each DDS server of a name receives every request: this one counts them without an answer.
        participant.serve(srv.Sealed, path, lambda request, _: seen.append(request))

        def look(seconds: float) -> None:
            until = time.monotonic() + seconds
            while time.monotonic() < until:
                participant.spin(0.05)

        # The first request shows that DDS discovered this server. Renewals end at one per half
        # minute.
        wait_until(lambda: seen, "a renewal", timeout=2 * PATIENCE, pause=participant.spin)
        for _ in range(8):  # the first intervals are shorter
            seen.clear()
            look(2.5)
            if not seen:
                break
        assert seen == []
        narrow.run(job("one-more", "true"))  # its assignment is an order, so the request stays open
        look(0.5)
        assert len(seen) <= 1
    assert qos.SERVICE.depth >= 1000


@pytest.fixture(scope="module")
def two(make_shared):
    """Yield two hosts of 1 and 2 GiB; a process is charged its declared needs."""
    limits = {"memory": 0.5, "cpu": 1.0}
    return make_shared(
        host("small", memory=1024 * MIB, limits=limits),
        host("large", memory=2048 * MIB, limits=limits, labels={"arm": "left"}),
        defaults=ProcessDefaults(needs={"memory": MIB}),
        queue=QueueSettings(backfill=False),
    )


def test_nothing_is_assigned_over_a_limit(two) -> None:
    """With 512 MiB and 1 GiB allowed, twelve processes of 120 MiB exceed no limit."""
    specs = [holder(f"m{n:02}", 110) for n in range(14)]
    two.submit(*specs)
    view = two.wait_until(
        "12 running", lambda v: sum(r.state == "running" for r in v.processes) >= 12
    )
    assert on(view, "small") == 4
    assert on(view, "large") == 8
    for name in [f"m{n:02}" for n in range(12)]:
        two.wait_for_log(name, "held")
    two.stays(
        1.5, lambda: all(one.usage <= one.limit + 0.01 for one in memory(two)), "below the limits"
    )
    rows = two.client.list(processes=True).processes
    waiting = [row for row in rows if row.state == "queued"]
    assert [row.name for row in waiting] == ["m12", "m13"]
    assert waiting[0].reason == "no host can take it now"
    story = two.client.explain("m12")
    assert "memory" in str(story["decision"])
    two.cancel("m00")
    two.wait("m12", "running")
    two.cancel(*[spec.name for spec in specs if spec.name != "m00"])


def test_labels(two) -> None:
    """Required labels are binding: the process is set aside without; preferred ones are not."""
    two.submit(service("driver", required_labels={"arm": "left"}))
    assert two.wait("driver", "running").host == "large"
    two.submit(service("other-arm", required_labels={"arm": "right"}))
    assert "arm" in two.wait("other-arm", "set_aside").reason
    two.submit(
        service("prefers", preferred_labels={"arm": "left"}),
        service("avoids", avoided_labels={"arm": "left"}),
    )
    assert two.wait("prefers", "running").host == "large"
    assert two.wait("avoids", "running").host == "small"
    two.cancel("driver", "other-arm", "prefers", "avoids")


def test_a_host_over_its_limit_takes_nothing(two) -> None:
    """A host over its limit neither asks for nor gets work until memory is freed."""
    two.client.set_host_state("large", "cordon")
    # The process declares little and uses much: only the readings show this.
    two.submit(holder("liar", 600, needs={"memory": 1.0 * MIB}))
    two.wait("liar", "running")

    def over(view) -> bool:
        row = next(r for r in view.hosts if r.description.name == "small")
        memory = next(r for r in row.resources if r.name == "memory")
        return memory.usage > memory.limit and not row.accepting

    two.wait_until("small over its limit", over)
    two.submit(job("waits", "true"))
    two.stays(1.0, lambda: two.process("waits").state == "queued", "queued")
    two.cancel("liar")
    assert two.ended("waits").state == "finished"
    two.client.set_host_state("large", "uncordon")


def test_a_chain_of_policies_decides_and_explains_each_part(make_cluster) -> None:
    """The master adds the weighted scores, and the explanation has the part of each policy."""
    chain = (ScoringChoice("weighted"), ScoringChoice("threshold", 0.5))
    cluster = make_cluster(host("x"), host("y"), scoring=chain)
    cluster.submit(service("placed", needs={"memory": 100.0 * MIB, "cpu": 0.1}))
    cluster.wait("placed", "running")
    decision = cluster.client.explain("placed")["decision"]
    assert decision["policy"] == "weighted + 0.5 x threshold"
    parts = r"weighted \d\.\d{3} \(.*\) \+ 0\.5 x threshold \d\.\d{3} \("
    for row in decision["hosts"]:
        assert re.match(parts, row["reason"])


def test_another_policy_places_and_explains(make_cluster) -> None:
    """Under the policy that the cluster names, too, the explanation has every host."""
    cluster = make_cluster(
        host("x"), host("y", memory=256 * MIB), scoring=(ScoringChoice("threshold"),)
    )
    cluster.submit(service("placed", needs={"memory": 100.0 * MIB, "cpu": 0.1}))
    assert cluster.wait("placed", "running").host in ("x", "y")
    story = cluster.client.explain("placed")
    assert story["decision"]["policy"] == "threshold"
    assert {row["name"] for row in story["decision"]["hosts"]} == {"x", "y"}
    assert any("assigned" in entry["kind"] for entry in story["history"])
