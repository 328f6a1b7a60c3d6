"""Placement: the largest margin, first in first out, never over a limit."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import replace

import pytest

from rosrm.config.settings import ProcessDefaults, QueueSettings, ScoringChoice
from rosrm.ros import names, qos
from rosrm.ros.participant import Participant
from rosrm_msgs import srv
from tests.ros.clusters import MIB, PATIENCE, STEADY, host, job, python, service

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


def test_a_cancelled_one_leaves_the_queue(narrow) -> None:
    """A cancelled process never runs, and those behind it move up."""
    narrow.submit(service("front"))
    narrow.wait("front", "running")
    narrow.submit(job("never", "true"), job("next", "true"))
    narrow.client.cancel(["never"])
    assert narrow.process("never").state == "cancelled"
    assert narrow.process("next").queue_position == 1
    narrow.cancel("front")
    assert narrow.ended("next").state == "finished"
    assert "assigned" not in narrow.kinds("never")


def test_an_idle_cluster_is_quiet(narrow) -> None:
    """The slave keeps one request for work open, and sends no other while there is none."""
    with Participant(narrow.ros, "rosrm_test_counter") as participant:
        seen = []
        path = names.Names("/rosrm")(names.REQUEST_PROCESS)
        # Each DDS server of a name receives every request: this one counts them without an answer.
        participant.serve(srv.RequestProcess, path, lambda request, _: seen.append(request))
        number = 0
        while not seen:  # until it is discovered
            number += 1
            assert number < 100, "the request after a job was never seen"
            narrow.run(job(f"wakes-{number}", "true"))
            look(participant, 0.3)
        for _ in range(3):  # a request may be late, or renewed after half a minute
            seen.clear()
            look(participant, 2.5)
            if not seen:
                break
        assert seen == []
        narrow.run(job("one-more", "true"))
        look(participant, PATIENCE, lambda: bool(seen))
        look(participant, 0.5)
        assert len(seen) == 1
    assert qos.SERVICE.depth >= 1000


def look(participant, seconds: float, found=lambda: False) -> None:
    deadline = time.monotonic() + seconds
    while (left := deadline - time.monotonic()) > 0 and not found():
        participant.spin(min(left, 0.1))


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
    deadline = time.monotonic() + 1.5
    while time.monotonic() < deadline:
        view = two.client.list(hosts=True, processes=True)
        for row in view.hosts:
            memory = next(r for r in row.resources if r.name == "memory")
            assert memory.usage <= memory.limit + 0.01, row
        two.client.spin(0.1)
    waiting = [row for row in view.processes if row.state == "queued"]
    assert [row.name for row in waiting] == ["m12", "m13"]
    assert waiting[0].reason == "no host can take it now"
    story = two.client.explain("m12")
    assert "memory" in str(story["decision"])
    two.cancel("m00")
    two.wait("m12", "running")
    two.cancel(*[spec.name for spec in specs if spec.name != "m00"])


def test_needs_larger_than_every_host_are_set_aside(two) -> None:
    """The process has the reason and blocks no other; a host with room brings it back."""
    two.submit(service("giant", needs={"memory": 3000.0 * MIB}), job("behind", "true"))
    assert two.ended("behind").state == "finished"
    row = two.wait("giant", "set_aside")
    assert "memory" in row.reason
    two.cancel("giant")


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
    deadline = time.monotonic() + 1.0
    while time.monotonic() < deadline:
        two.client.spin(0.1)
        assert two.process("waits").state == "queued"
    two.cancel("liar")
    assert two.ended("waits").state == "finished"
    two.client.set_host_state("large", "uncordon")


def test_a_cordoned_host_takes_nothing(two) -> None:
    """A cordoned host gets no work until it is uncordoned."""
    for name in ("small", "large"):
        two.client.set_host_state(name, "cordon")
    two.submit(job("patient", "true"))
    assert two.process("patient").state in ("queued", "set_aside")
    assert "cordoned" in str(two.client.explain("patient"))
    two.client.set_host_state("small", "uncordon")
    assert two.ended("patient").state == "finished"
    two.client.set_host_state("large", "uncordon")


@pytest.mark.parametrize("policy", ["weighted", "threshold"])
def test_explain_names_every_host(make_cluster, policy) -> None:
    """The explanation has the score of each host, under either policy."""
    cluster = make_cluster(host("x"), host("y", memory=256 * MIB), scoring=ScoringChoice(policy))
    cluster.submit(service("placed", needs={"memory": 100.0 * MIB, "cpu": 0.1}))
    assert cluster.wait("placed", "running").host in ("x", "y")
    story = cluster.client.explain("placed")
    text = str(story["decision"])
    assert "x" in text
    assert "y" in text
    assert any("assigned" in entry["kind"] for entry in story["history"])
    cluster.cancel("placed")
