"""Failed migrations by criu: the reason, a source that runs on, and no remains of the attempt."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

from tests.integration.criu.conftest import old  # noqa: F401 - a fixture
from tests.ros.clusters import PATIENCE, host, node
from tests.ros.portable_kit import NAME, ask, counter, nothing_left, two_hosts

TROUBLED = str(Path(__file__).parent / "programs/troubled.py")


@pytest.fixture(scope="module")
def cluster(make_shared):
    return two_hosts(make_shared)


@pytest.fixture
def running(criu, cluster, listener):
    """Yield a function that starts a counter; cancel it after the test."""

    def start(*arguments: str, **fields) -> str:
        cluster.submit(counter(*arguments, **fields))
        row = cluster.wait(NAME, "running")
        listener.receive(10)
        return row.host

    yield start
    cluster.cancel(NAME)


def stayed(cluster, listener) -> str:
    """Return the reason of a failed migration; the node counts on, and nothing of it is left."""
    before = cluster.client.list().last_sequence
    assert not ask(cluster)
    event = cluster.wait_for_event("stayed", process=NAME, after=before, timeout=60.0)
    cluster.wait(NAME, "running")
    listener.receive(30)
    assert min(listener.steps()) == 1
    nothing_left(cluster)
    return event.message


@pytest.mark.parametrize(
    ("which", "reason"),
    [
        ("none", "names a CRIU that cannot be used"),
        ("bookworm", "CRIU 3.17.1 is too old, 4.2 is needed"),
        ("trixie", "CRIU 4.1.1 is too old, 4.2 is needed"),
    ],
)
def test_a_host_without_a_criu_that_works_gets_nothing(
    which, reason, cluster, listener, running, request, monkeypatch, tmp_path
):
    """The request is refused with the reason, which is an event since the host registered."""
    program = tmp_path / "criu"
    if which != "none":
        program = Path(request.getfixturevalue("old")(which).command[-1])
    running()
    with monkeypatch.context() as changed:
        changed.setenv("ROSRM_CRIU", str(program))
        cluster.add(host(which))
    refusal = ask(cluster, which)
    assert f"criu does not work on {which}" in refusal
    assert reason in refusal
    assert str(program) in refusal or which != "none"
    absent = cluster.wait_for_event("strategy_absent", host=which)
    assert reason in absent.message
    listener.receive(30)
    assert set(listener.steps()) == {1}
    part = cluster.slaves.pop(which)
    part.end(signal.SIGINT)
    part.process.wait(PATIENCE)


def test_there_is_no_working_directory_at_the_destination(cluster, listener, running, tmp_path):
    """The error precedes the request to leave: no count is late."""
    place = tmp_path / "place"
    place.mkdir()
    running(working_directory=str(place))
    place.rmdir()
    why = stayed(cluster, listener)
    assert f"its working directory {place} does not exist on" in why
    assert why.endswith("make it")
    assert set(listener.steps()) == {1}


def test_the_destination_has_no_room(cluster, listener, running):
    """The reserve at the destination is larger than the free space."""
    running(options={"reserve": 10**15})
    why = stayed(cluster, listener)
    assert "do not fit beside" in why
    assert f"{10**15} are to stay free" in why


def test_an_image_that_was_damaged_is_not_restored(cluster, listener, running):
    """A file is cut short before the restore; afterwards both ends have no image."""
    source = running()
    other = {"left": "right", "right": "left"}[source]
    images = cluster.directory / "hosts" / other / "images"
    cutter = threading.Thread(target=cut_short, args=(images,))
    cutter.start()
    why = stayed(cluster, listener)
    cutter.join(PATIENCE)
    assert "is damaged: criu/core-" in why  # found by its size or by its content, which comes first
    assert "bytes instead of" in why or "ends within a field" in why


def cut_short(images: Path) -> None:
    """Cut the first file of a process's registers that arrives."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        for file in images.glob("in-*/criu/core-*.img"):
            os.truncate(file, file.stat().st_size // 2)
            return
        time.sleep(0.001)


def test_a_process_with_a_pipe_to_another_one_is_not_dumped(cluster, listener, running):
    """The error names the descriptor and the process at the other end."""
    running("pipe", command=(sys.executable, TROUBLED))
    why = stayed(cluster, listener)
    assert "is a pipe that it shares with pid" in why
    assert "(cat)" in why


def test_a_node_that_hangs_in_a_callback_is_left_alone(cluster, listener, running, tmp_path):
    """The timeout is that of the option; after its callback the node runs as before."""
    block = tmp_path / "block"
    running("hangs", str(block), command=(sys.executable, TROUBLED), options={"leave_timeout": 1.0})
    before = cluster.client.list().last_sequence
    block.touch()
    assert not ask(cluster)
    event = cluster.wait_for_event("stayed", process=NAME, after=before, timeout=60.0)
    assert "the node has not left the ROS graph within 1 s" in event.message
    assert "a callback may be taking its time" in event.message
    block.unlink()
    listener.receive(30)
    assert set(listener.steps()) == {1}
    nothing_left(cluster)


def test_a_node_that_cannot_leave_says_what_to_use(criu, cluster):
    """An ordinary node is not touched; the error names the library for portable nodes."""
    cluster.submit(node("ordinary", migration=counter().migration))
    cluster.wait("ordinary", "running")
    assert not ask(cluster, name="ordinary")
    event = cluster.wait_for_event("stayed", process="ordinary", timeout=60.0)
    assert "does not use rosrm_criu.node.run_portable" in event.message
    assert cluster.process("ordinary").state == "running"
    nothing_left(cluster)
    cluster.cancel("ordinary")
