"""Second masters and slaves, and unusable state directories: refused with the reason."""

from __future__ import annotations

import signal
from dataclasses import replace

import pytest

from tests.ros.clusters import PATIENCE, host, job, pids_of, service
from tests.waiting import holds_for, wait_until


@pytest.fixture(scope="module")
def cluster(make_shared):
    return make_shared(host("h0"))


def refused(cluster, part, code: int = 1) -> str:
    """Wait until a part has ended with an exit code; return its log."""
    assert part.process.wait(PATIENCE) == code
    said = cluster.log_of(part.name)
    assert "Traceback" not in said
    return said


def test_a_second_master_is_refused_naming_the_first(cluster) -> None:
    """A second master is refused on the same state directory, and on the same domain."""
    first = cluster.master
    same = cluster.start_master()
    cluster.master = first
    said = refused(cluster, same)
    assert f"a master runs already on {cluster.directory / 'master'}" in said
    assert f"pid {first.process.pid}" in said

    other = replace(cluster.cluster, name="rival", ros=cluster.ros, state=cluster.directory / "m2")
    said = refused(cluster, cluster._start("master2", "rosrm.master", other.to_json()))
    assert "a master runs already" in said
    assert f"pid {first.process.pid}" in said
    assert cluster.run(job("undisturbed", "true"))[0].state == "finished"


def test_a_master_whose_host_has_another_master_is_refused(make_cluster) -> None:
    """The search ends early only if no other master has a host of the journal."""
    cluster = make_cluster(host("h0"))
    cluster.submit(service("p"))
    cluster.wait("p", "running")
    cluster.end(cluster.master, signal.SIGINT)
    cluster.reconnect()
    other = replace(cluster.cluster, name="other", ros=cluster.ros, state=cluster.directory / "m2")
    second = cluster._start("master2", "rosrm.master", other.to_json())
    cluster.wait_for_hosts()
    first = cluster.start_master()
    cluster.master = second
    said = refused(cluster, first)
    assert f"a master runs already on {cluster.ros.describe()}: 'other'" in said
    assert f"pid {second.process.pid}" in said
    assert said.count("h0 registered") == 1  # with the first run of this master
    assert cluster.run(job("undisturbed", "true"))[0].state == "finished"


def test_of_two_masters_at_once_one_stays(make_cluster) -> None:
    """Two masters that start at once cannot see each other; one ends and names the other."""
    cluster = make_cluster(started=False)
    names = ("twin0", "twin1")
    settings = [
        replace(cluster.cluster, name=name, ros=cluster.ros, state=cluster.directory / name)
        for name in names
    ]
    parts = [cluster._start(one.name, "rosrm.master", one.to_json()) for one in settings]
    try:
        wait_until(lambda: any(p.process.poll() is not None for p in parts), "one master ends")
        ended = next(part for part in parts if part.process.poll() is not None)
        stays = next(part for part in parts if part is not ended)
        assert ended.process.returncode == 1
        assert f"pid {stays.process.pid}" in cluster.log_of(ended.name)
        holds_for(1.0, lambda: stays.process.poll() is None, "the other master runs")
    finally:
        for part in parts:
            cluster.end(part, signal.SIGINT)


def test_a_second_slave_of_a_name_is_refused(cluster) -> None:
    """A second slave is refused by its state directory at once, or later by the master."""
    cluster.submit(service("p"))
    before = cluster.wait("p", "running")
    first = cluster.slaves["h0"]
    same = cluster.start_slave(host("h0"))
    cluster.slaves["h0"] = first
    said = refused(cluster, same)
    assert f"a slave runs already on {cluster.directory / 'hosts' / 'h0'}" in said
    assert f"pid {first.process.pid}" in said

    state = cluster.directory / "hosts" / "impostor"
    settings = replace(host("h0"), ros=cluster.ros, state=state)
    said = refused(cluster, cluster._start("impostor", "rosrm.slave", settings.to_json()))
    assert "a live slave has the name 'h0' already" in said
    assert f"pid {first.process.pid}" in said
    wait_until(lambda: not pids_of(state), "no supervisor of the impostor")
    assert cluster.process("p").pid == before.pid
    assert first.process.poll() is None


def test_an_unusable_state_directory_is_refused(cluster, tmp_path) -> None:
    """The error has the path and no traceback."""
    (tmp_path / "file").write_text("")
    state = tmp_path / "file" / "state"
    for module, settings in (
        ("rosrm.master", replace(cluster.cluster, ros=cluster.ros, state=state)),
        ("rosrm.slave", replace(host("h9"), ros=cluster.ros, state=state)),
    ):
        part = cluster._start(module, module, settings.to_json())
        assert f"the state directory {state} cannot be used" in refused(cluster, part, code=2)
