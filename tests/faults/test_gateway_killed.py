"""`rosrm web` killed repeatedly while browsers and programs use it; the cluster is not affected."""

from __future__ import annotations

import signal
import threading
from contextlib import ExitStack, contextmanager, suppress
from http.client import HTTPException

import psutil
from websockets.sync.client import connect

from rosrm.ros import fast_dds
from rosrm.ros.names import slave_node
from tests.ros.clusters import host, job, service
from tests.ros.web_kit import Gateway, gateway
from tests.waiting import PATIENCE, wait_until

#: Kills of the gateway.
KILLS = 20
#: Kills after which the memory of the master is compared with that at the end.
FIRST_KILLS = 5
#: Seconds after which the peers of a killed gateway forget it here; by default 120.
LEASE = 5
#: Bytes by which the master may grow over 15 kills of three clients each; 0.9 MB were measured,
#: also of the jobs in its record.
GROWTH = 4e6


def shorten_lease(monkeypatch, tmp_path):
    """Let gateways that start from now on announce a short lease."""
    profile = fast_dds._PROFILES / "eager-udp.xml"
    lease = f"<leaseDuration><sec>{LEASE}</sec></leaseDuration>"
    file = tmp_path / "profile.xml"
    file.write_text(profile.read_text().replace(fast_dds._BEFORE, lease + fast_dds._BEFORE, 1))
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(file))
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")


def ask_until_it_ends(web: Gateway) -> None:
    """Request listings, metrics and logs as fast as they come."""
    with suppress(OSError, HTTPException):
        while True:
            for path in ("/v1/processes", "/metrics", "/v1/logs/talker-0", "/v1/explain/talker-0"):
                web.ask(path)


@contextmanager
def load(web: Gateway):
    """Keep readers of changes, a page and threads with requests busy."""
    page = f"ws{web.url.removeprefix('http')}/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
    threads = [threading.Thread(target=ask_until_it_ends, args=(web,)) for _ in range(4)]
    with ExitStack() as stack:
        for _ in range(4):
            assert next(stack.enter_context(web.follow())).kind == "master"
        assert stack.enter_context(connect(page)).recv(PATIENCE).startswith("0")
        for thread in threads:
            thread.start()
        yield
        assert web.end(signal.SIGKILL) == -signal.SIGKILL
        for thread in threads:
            thread.join()


def test_nothing_notices_a_gateway_that_is_killed_20_times(make_cluster, monkeypatch, tmp_path):
    """The record has no trace of the kills, no cycle is missed, and the master drops clients."""
    made = make_cluster(host("robot-1"), host("robot-2"))
    names = [f"talker-{number}" for number in range(10)]
    made.submit(*map(service, names))
    for name in names:
        made.wait(name, "running")
    shorten_lease(monkeypatch, tmp_path)
    graph = made.client._participant.node.get_node_names
    parts = {"rosrm_master", slave_node("robot-1"), slave_node("robot-2")}
    wait_until(
        lambda: parts <= set(graph()), "all parts in the graph", seen=graph, pause=made.client.spin
    )
    others, master = sorted(graph()), psutil.Process(made.master.process.pid)
    before, sizes = made.client.list().last_sequence, []
    for number in range(KILLS):
        with gateway(made.ros) as web:
            web.wait_for_master("up")
            with load(web):
                made.run(job(f"job-{number}", "true"))
        sizes.append((master.memory_info().rss, master.num_fds(), master.num_threads()))

    # The record has the jobs only: no host was suspect, no process was touched.
    assert {row.process[:4] for row in made.client.list(events=True, after=before).events} == {
        "job-"
    }
    rows = made.client.list(processes=True).processes
    assert all(row.state == "running" for row in rows if row.name in names)
    with gateway(made.ros) as web:
        web.wait_for_master("up")
        wait_until(
            lambda: b"\nrosrm_missed_cycles 0.0\n" in web.ask("/metrics").body,
            "no cycle of a slave was missed",
        )
    (memory, files, threads), (memory_at_end, *_) = sizes[FIRST_KILLS], sizes[-1]
    assert memory_at_end - memory < GROWTH
    wait_until(  # it may have a file open just now
        lambda: master.num_fds() <= files and master.num_threads() <= threads,
        "the master has no more files and threads than before",
    )
    wait_until(
        lambda: sorted(graph()) == others, "the killed gateways leave the graph",
        seen=graph, pause=made.client.spin,
    )  # fmt: skip
