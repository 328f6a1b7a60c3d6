"""Logs of real processes: rotation, size limits and pruning."""

from __future__ import annotations

import pytest

from rosrm.core.supervisor.events import StatusStored, StopOrdered
from rosrm.errors import Refused
from rosrm.model.values import InstanceId, InstanceState, RestartPolicy
from rosrm.slave.logs import newest_instance
from rosrm.supervisor import log_index
from rosrm.supervisor.logs import PROCESSES_AT_ONCE, LogLimits
from rosrm.supervisor.messages import Forget
from tests.waiting import wait_until

KIB = 1024
FLOOD = """
import time
line = b"x" * 1023 + b"\\n"
with open("/dev/stdout", "ab", buffering=0) as out:
    while True:
        out.write(line * 64)
        time.sleep(0.01)
"""


def test_a_flood_is_bounded(host):
    """The number and size of log files stay within the limits, however much is written."""
    limits = LogLimits(max_bytes=256 * KIB, keep=2)
    client = host.connect(log=limits)
    client.start([host.python("flood", FLOOD)])
    log = host.log("flood")
    oldest = log.with_name(log.name + ".2")
    wait_until(oldest.exists, "two rotations")
    first = oldest.stat().st_ino
    wait_until(lambda: oldest.stat().st_ino != first, "a third rotation")
    client.send(StopOrdered(("flood", 1)))
    host.ended(client, "flood")
    files = [file for file in log.parent.iterdir() if file.suffix != ".times"]
    assert sorted(file.name for file in files) == ["flood.1.log", "flood.1.log.1", "flood.1.log.2"]
    assert all(file.stat().st_size <= limits.max_bytes + 100 for file in files)


def test_a_rotated_log_keeps_its_newest_lines(host):
    """The oldest bytes are dropped, and the index has their number."""
    client = host.connect(log=LogLimits(max_bytes=10 * KIB, keep=1))
    host.run(client, host.order("count", "seq", "1", "10000"))
    rotated = host.log("count").with_name("count.1.log.1")
    kept = rotated.read_text()
    assert kept.endswith("10000\n")
    dropped = sum(len(f"{number}\n") for number in range(1, 10001)) - len(kept)
    assert log_index.base(str(rotated)) == dropped


def test_logs_of_old_instances_are_pruned(host):
    """Only the logs of a process's newest instances stay, with the files beside them."""
    client = host.connect(log=LogLimits(instances=3))
    for number in range(1, 6):
        host.log("many", number).with_suffix(".parameters.yaml").write_text("{}")
        host.run(client, host.order("many", "true", number=number))
        client.send(Forget((StatusStored(("many", number)),)))
    numbers = {file.name.split(".")[1] for file in host.log("many").parent.iterdir()}
    assert numbers == {"3", "4", "5"}
    assert newest_instance(host.state, "many") == InstanceId("many", 5)


def test_the_index_of_logs_survives_the_supervisor(host):
    """A new supervisor knows the existing logs, and prunes them, too."""
    client = host.connect(log=LogLimits(instances=2))
    for number in range(1, 3):
        host.run(client, host.order("many", "echo", "output", number=number))
        client.send(Forget((StatusStored(("many", number)),)))
    host.kill_supervisor(client)
    client = host.connect(log=LogLimits(instances=2))
    host.run(client, host.order("many", "echo", "output", number=3))
    assert sorted(file.name for file in host.log("many").parent.iterdir()) == [
        "many.2.log", "many.2.log.times", "many.3.log", "many.3.log.times",
    ]  # fmt: skip


def test_logs_of_old_processes_are_pruned(host):
    """Jobs with unique names leave a bounded number of logs."""
    client = host.connect(log=LogLimits(processes=10))
    for number in range(100):
        host.run(client, host.order(f"job{number}", "true", number=number))
        client.send(Forget((StatusStored((f"job{number}", number)),)))
    left = list(host.log("any").parent.iterdir())
    assert len(left) < 2 * (10 + PROCESSES_AT_ONCE)
    assert newest_instance(host.state, "job99") == InstanceId("job99", 99)
    with pytest.raises(Refused):
        newest_instance(host.state, "job0")


def test_logs_with_numbers_in_the_name_stay_apart(host, client):
    """The processes `a` and `a.1` have separate logs."""
    host.run(client, host.order("a", "echo", "first", number=2))
    host.run(client, host.order("a.1", "echo", "second", number=3))
    assert newest_instance(host.state, "a") == InstanceId("a", 2)
    assert newest_instance(host.state, "a.1") == InstanceId("a.1", 3)


@pytest.mark.parametrize(
    "name", ["../../ns/talker é", "/absolute", "with space", "a\nb", "."], ids=repr
)
def test_any_process_name_is_a_safe_file_name(host, name):
    """A process name with slashes and dots gives a path below the log folder."""
    client = host.connect()
    host.run(client, host.order(name, "echo", "hello"))
    assert host.log(name).read_text() == "hello\n"
    assert host.state / "logs" in host.log(name).resolve().parents


def test_the_bound_leaves_what_a_restart_needs(host):
    """A supervisor ends while services wait for their restarts.

    The next supervisor applies the bound after its first start; the other service still waits.
    """
    limits = LogLimits(max_bytes=64 * KIB, keep_bytes=100 * KIB)
    client = host.connect(log=limits)
    script = f"[ -e {host.state}/later ] && exec sleep 1000; head -c 50K /dev/zero; exit 1"
    files = [host.log("waits", n).with_suffix(".parameters.yaml") for n in (1, 2)]
    for number, file in enumerate(files, 1):
        file.write_text("speed: 1\n")
        restart = RestartPolicy("on-failure", delay=[4.0, 0.2][number - 1], attempts=100)
        client.start([host.order("waits", "sh", "-c", script, number=number, restart=restart)])
        host.wait(client, "waits", InstanceState.BACKOFF, number=number)
    host.kill_supervisor(client)
    (host.state / "later").touch()
    with host.log("waits", 2).open("ab") as log:
        log.write(bytes(10 * KIB))
    client = host.connect(log=limits)
    up = {one.instance.number for one in client.instances if one.state is InstanceState.RUNNING}
    wait_until(
        lambda: up.update(
            one.instance.number for one in client.receive(1.0) if one.state is InstanceState.RUNNING
        ) or up == {1, 2},
        "both services", seen=lambda: up,
    )  # fmt: skip
    assert all(file.exists() for file in files)
