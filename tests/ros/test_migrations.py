"""Migrations between hosts: by order, by eviction, and by draining."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from rosrm.config.settings import MigrationSettings, ProcessDefaults
from rosrm.model.values import MigrationPolicy, Readiness
from tests.ros.clusters import (
    CALM,
    MIB,
    NODE,
    STEADY,
    alive,
    host,
    left_and_right,
    node,
    python,
    service,
)
from tests.waiting import wait_gone, wait_until

MOVES = MigrationPolicy("relaunch")
STOPS_FIRST = MigrationPolicy("relaunch", overlap=False)


@pytest.fixture(scope="module")
def cluster(make_shared):
    return left_and_right(make_shared)


def other(name: str) -> str:
    return {"left": "right", "right": "left"}[name]


def moved(cluster, name: str):
    return cluster.wait(name, "running", migrations=1)


def started(folder, runs: int) -> None:
    """Wait until this number of runs has written its start time."""
    wait_until(
        lambda: sum(bool(path.read_text()) for path in folder.iterdir()) == runs,
        f"{runs} runs at work",
    )


#: Writes the time of its start (from its /proc entry) and of its end.
RECORDER = """
import os, signal, sys, time
log = os.open(os.path.join(sys.argv[1], str(os.getpid())), os.O_WRONLY | os.O_CREAT)
def end(*_):
    os.write(log, b"%f\\n" % time.clock_gettime(time.CLOCK_BOOTTIME))
    os._exit(0)
signal.signal(signal.SIGINT, end)
birth = int(open("/proc/self/stat").read().rpartition(")")[2].split()[19])
os.write(log, b"%f\\n" % (birth / os.sysconf("SC_CLK_TCK")))
time.sleep(1000)
"""


def recorder(cluster, name: str, migration: MigrationPolicy):
    folder = cluster.directory / name
    folder.mkdir()
    spec = python(name, RECORDER, migration=migration, stop=CALM)
    return replace(spec, arguments=(str(folder),)), folder


@pytest.mark.parametrize(("name", "migration"), [("overlaps", MOVES), ("apart", STOPS_FIRST)])
def test_the_order_of_start_and_stop(cluster, name, migration) -> None:
    """By default the new instance is ready before the old one stops; then it runs alone.

    With `overlap: false` the old instance ends before the new one starts.
    """
    spec, folder = recorder(cluster, name, migration)
    cluster.submit(spec)
    before = cluster.wait(name, "running")
    started(folder, 1)
    assert "moves to" in cluster.client.migrate(name)
    after = moved(cluster, name)
    assert after.host == other(before.host)
    wait_gone(before.pid)
    assert alive(after.pid)
    started(folder, 2)
    cluster.cancel(name)
    runs = [list(map(float, path.read_text().split())) for path in folder.iterdir()]
    (_, first_end), (second_begin, _) = sorted(runs)
    if name == "overlaps":
        assert second_begin <= first_end
    else:
        assert first_end <= second_begin + 1 / os.sysconf("SC_CLK_TCK")  # starts are in ticks
    kinds = cluster.kinds(name)
    assert kinds.index("migration_begun") < kinds.index("migrated")


def test_a_ros_node_moves_under_its_own_name(cluster) -> None:
    """The new instance of a name counts only when seen in the graph apart from the source."""
    cluster.submit(node("walker", migration=MOVES))
    before = cluster.wait("walker", "running")
    cluster.client.migrate("walker")
    after = moved(cluster, "walker")
    assert after.pid != before.pid
    wait_gone(before.pid)
    cluster.wait_for_log("walker", "/walker")
    cluster.cancel("walker")


def loyal(name: str, home: Path, *, overlap: bool):
    """Return a node that never joins the graph on any host but its `home`, if that file exists."""
    code = (
        "import os, sys, time\n"
        f"if os.path.exists({str(home)!r}) and os.environ['ROSRM_HOST'] != "
        f"open({str(home)!r}).read(): time.sleep(1000)\n"
    )
    return node(
        name, code + NODE, readiness=Readiness(timeout=12.0),  # in time at home
        migration=MigrationPolicy("relaunch", overlap=overlap),
    )  # fmt: skip


def test_a_destination_that_never_gets_ready_changes_nothing(cluster) -> None:
    """The process stays, or restarts, on the source host; the migration is undone, with an event.

    Two run at once: one that starts the destination first, and one that stops the source first.
    """
    overlaps = {"loyal_first": True, "loyal_after": False}
    homes = {name: cluster.directory / f"{name}-home" for name in overlaps}
    cluster.submit(*(loyal(name, homes[name], overlap=overlaps[name]) for name in overlaps))
    before = {name: cluster.wait(name, "running") for name in overlaps}
    for name, row in before.items():
        homes[name].write_text(row.host)
        cluster.client.migrate(name)
    for name, row in before.items():
        stayed = cluster.wait_for_event("stayed", process=name, timeout=60.0)
        assert stayed.host == row.host
        after = cluster.wait(name, "running")
        assert after.host == row.host
        assert after.migrations == 0
        assert (after.pid == row.pid) == overlaps[name]
    cluster.cancel(*overlaps)


def test_drain_empties_a_host(cluster) -> None:
    """Movable processes leave, the others stay and are named; uncordon opens the host."""
    cluster.client.set_host_state("right", "cordon")
    cluster.submit(*(service(f"d{n}", migration=MOVES) for n in range(3)), service("fixed"))
    for name in ("d0", "d1", "d2", "fixed"):
        assert cluster.wait(name, "running").host == "left"
    cluster.client.set_host_state("right", "uncordon")
    cluster.client.set_host_state("left", "drain")
    for name in ("d0", "d1", "d2"):
        assert moved(cluster, name).host == "right"
    assert cluster.process("fixed").host == "left"
    cluster.wait_for_event("host_drained", "fixed has no migration strategy", host="left")
    row = cluster.host("left")
    assert (row.draining, row.drained, row.cordoned) == (True, True, True)
    cluster.client.set_host_state("left", "uncordon")
    row = cluster.host("left")
    assert (row.draining, row.drained, row.cordoned) == (False, False, False)
    cluster.cancel("d0", "d1", "d2", "fixed")


def test_cancel_during_a_move(cluster) -> None:
    """A cancellation during a migration leaves neither instance."""
    cluster.submit(node("fleeting", migration=MOVES))
    before = cluster.wait("fleeting", "running")
    cluster.client.migrate("fleeting")
    cluster.client.cancel(["fleeting"])
    assert cluster.ended("fleeting").state == "cancelled"
    wait_gone(before.pid)
    view = cluster.wait_until(
        "both hosts empty", lambda v: all(row.processes == 0 for row in v.hosts)
    )
    assert not [row for row in view.processes if row.state == "migrating"]


# --- eviction ---------------------------------------------------------------------------------

#: Holds 50 MiB, and further MiB once the file exists: all at once, even on a busy machine.
GROWS = """
import mmap, os, sys, time
def hold(mib):
    return mmap.mmap(-1, mib << 20, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | mmap.MAP_POPULATE)
first = hold(50)
while not os.path.exists(sys.argv[1]): time.sleep(0.02)
if os.environ["ROSRM_HOST"] == sys.argv[2]: second = hold(int(sys.argv[3]))
time.sleep(1000)
"""


def grower(cluster, name: str, where: str, mib: int, **options):
    go = cluster.directory / f"{name}-go"
    spec = python(name, GROWS, needs={"memory": 60.0 * MIB}, **options)
    return replace(spec, arguments=(str(go), where, str(mib))), go


def test_eviction_from_a_host_over_its_limit(make_cluster) -> None:
    """After the hysteresis the process that helps most and fits elsewhere leaves; others stay."""
    hysteresis = 4.0  # seconds; by then the master knows the size of each process
    limits = {"memory": 0.5, "cpu": 1.0}
    cluster = make_cluster(
        host("full", memory=1000 * MIB, limits=limits),
        host("free", memory=1000 * MIB, limits=limits),
        migration=MigrationSettings(hysteresis=hysteresis, cooldown=60.0),
        defaults=ProcessDefaults(needs={"memory": MIB}), liveness=STEADY,
    )  # fmt: skip
    cluster.client.set_host_state("free", "cordon")
    big, go = grower(cluster, "big", "full", 460, migration=MOVES)
    small, _ = grower(cluster, "small", "nowhere", 1, migration=MOVES)
    rooted, _ = grower(cluster, "rooted", "nowhere", 1)
    cluster.submit(big, small, rooted)
    for name in ("big", "small", "rooted"):
        assert cluster.wait(name, "running").host == "full"
    cluster.client.set_host_state("free", "uncordon")
    go.touch()
    over = cluster.wait_for_event("over_limit", host="full")
    # 510 MiB would put the other host over its limit, so only the small process fits there.
    begun = cluster.wait_for_event("migration_begun")
    assert begun.elapsed - over.elapsed >= hysteresis - 0.05
    assert begun.process == "small"
    assert moved(cluster, "small").host == "free"
    assert cluster.process("big").host == "full"
    assert cluster.process("rooted").host == "full"
    cluster.wait_for_event("nothing_moves", "rooted has no migration strategy", host="full")
    assert "small" not in {e.process for e in cluster.events("migration_begun")[1:]}
    cluster.cancel("big", "small", "rooted")
