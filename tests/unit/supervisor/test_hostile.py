"""Hostile or corrupt input of the supervisor: it is refused, and never ends the supervisor."""

from __future__ import annotations

import errno
import json
import math
import os
import socket
from types import SimpleNamespace

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, example, given, settings

from rosrm import clocks
from rosrm.core.supervisor import events
from rosrm.core.supervisor.instance import Instance
from rosrm.core.supervisor.reducer import SupervisorState
from rosrm.core.supervisor.rules import FenceRule, RestartRule, StopRule
from rosrm.model.durations import LONGEST_STOP
from rosrm.runtime.file_thread import FileThread
from rosrm.supervisor import endpoint, instance_record, messages, procfs, spawn, takeover
from rosrm.supervisor.json_lines import ProtocolError, line
from rosrm.supervisor.logs import LogLimits
from rosrm.supervisor.server import LONGEST_WAIT, Server
from tests.starting import executed
from tests.waiting import PATIENCE

TEN_YEARS = 10 * 365.25 * 86400.0
RESTART = ["always", 1.0, 30.0, 2.0, 5, 300.0]
DISK = FileThread("the state directory", patience=PATIENCE)
DEEP = b"[" * 100_000
#: Values that a field of a damaged or hostile line may have.
STRANGE = st.one_of(
    st.none(), st.booleans(), st.text(max_size=3), st.just([]), st.just({}), st.just([[]]),
    st.sampled_from([math.nan, math.inf, -math.inf, -1, -0.5, 1e300, 10**400, 2**63, 2**64]),
    st.just("\ud800"), st.just("a\0b"), st.just(["a", 1, 2]),
)  # fmt: skip


def start_fields(**changes):
    """Return the fields of an order to start, as the slave sends them."""
    launch = messages.Launch(
        ("a", 1), ("sleep", "1"), "base", {}, None, RestartRule(), StopRule(),
        fence=FenceRule(10.0, 1.0),
    )  # fmt: skip
    return {"do": "start", **json.loads(line(messages.launch_fields(launch))), **changes}


def state_fields(**changes):
    """Return the fields of a recorded state, as the supervisor writes them."""
    instance = Instance(("a", 1), RestartRule("always"), StopRule())
    fields = {name: getattr(instance, name) for name in Instance.__slots__}
    return {"record": "state", "birth": 1, **json.loads(line(fields)), **changes}


ORDERS = (
    start_fields(),
    {"do": "hello", "protocol": 3, "pid": 1, "log": [1, 2, 3, 4]},
    {"do": "environment", "id": "x", "variables": {"A": "1"}},
    {"do": "heard", "at": 1.0, "alive": 1.0},
    {"do": "fail", "instance": ["a", 1], "pid": 1, "reason": "", "kill": False},
    {"do": "amend", "instance": ["a", 1], "restart": RESTART, "changes": {}},
    {"do": "remember", "instance": ["a", 1], "memo": ""},
    {"do": "forget", "instances": [["a", 1]]},
)
RECORDS = (
    state_fields(),
    {**start_fields(), "record": "order"},
    {"record": "environment", "id": "x", "variables": {"A": "1"}},
    {"record": "spawning", "instances": [["a", 1]]},
    {"record": "dead", "process": "a", "number": 1, "key": ["a", 1]},
    {"record": "header", "version": 1, "boot": "x"},
)


@pytest.fixture
def server(tmp_path):
    """A server whose loop the test turns; it holds no process."""
    made = []

    def make() -> Server:
        listener = endpoint.listen(str(tmp_path / "state"))
        made.append(listener)
        return Server(str(tmp_path / "state"), listener, LogLimits())

    yield make
    for listener in made:
        listener.close()


@given(st.sampled_from(ORDERS), st.data())
def test_a_strange_order_is_refused(order, data):
    """A line is either an order or a `ProtocolError`, whatever value any of its fields has."""
    name = data.draw(st.sampled_from(sorted(order)))
    text = json.dumps({**order, name: data.draw(STRANGE)}).encode()
    try:
        messages.decode_order(text)
    except ProtocolError:
        return


@pytest.mark.parametrize(
    "text", [DEEP, b'{"do":' + DEEP, b'{"do": "stop", "instance": ["\\ud800", 1]}']
)
def test_a_line_that_only_an_attacker_writes_is_refused(text):
    """Python's decoder raises `RecursionError` for deep nesting; a surrogate names no file."""
    with pytest.raises(ProtocolError):
        messages.decode_order(text)


@pytest.mark.parametrize("seconds", [1e9, 1e300])
def test_a_wait_is_at_most_ten_years(seconds):
    """Records of earlier releases may hold longer ones: they are shortened, not refused."""
    fields = start_fields(
        restart=["always", seconds, seconds, 2.0, 5, seconds],
        stop=[seconds, seconds],
        fence=[seconds, seconds, False],
    )
    order = messages.decode_order(json.dumps(fields).encode())
    waits = (*order.restart[1:3], order.restart.window, *order.fence[:2])
    assert set(waits) == {TEN_YEARS}
    assert sum(order.stop) == LONGEST_STOP


@pytest.mark.parametrize("seconds", [math.nan, math.inf, -1.0, 10**400, "1", None, True])
def test_a_wait_that_is_no_time_is_refused(seconds):
    """NaN compares false with everything: a deadline of NaN made the loop spin."""
    for fields in (
        start_fields(restart=["always", seconds, 30.0, 2.0, 5, 300.0]),
        start_fields(stop=[seconds, 1.0]),
        start_fields(fence=[seconds, 1.0, False]),
        {"do": "heard", "at": seconds, "alive": 0.0},
    ):
        with pytest.raises(ProtocolError):
            messages.decode_order(json.dumps(fields).encode())


@given(st.sampled_from(RECORDS), st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_a_strange_record_is_left_out(tmp_path, record, data):
    """Each line is read or left out; what is read passes through the core and a compaction."""
    name = data.draw(st.sampled_from(sorted(record)))
    text = line({**record, name: data.draw(STRANGE)})
    (tmp_path / "instances.jsonl").write_bytes(text)
    check_record(tmp_path)


@given(st.sampled_from(["starting", "running", "stopping", "backoff", "exited"]), st.data())
@example("stopping", None)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_a_state_that_no_supervisor_writes_is_harmless(tmp_path, phase, data):
    """Fields may contradict each other: a stop without a deadline, a step that does not exist."""
    fields = state_fields(phase=phase, pid=2**22 + 1)
    if data is not None:
        names = st.sampled_from(sorted(Instance.__slots__))
        fields.update(data.draw(st.dictionaries(names, STRANGE, max_size=3)))
    (tmp_path / "instances.jsonl").write_bytes(line(fields))
    check_record(tmp_path)


def check_record(state):
    recorded = instance_record.read(str(state))
    core = SupervisorState()
    core.dead.update(recorded.dead)
    for instance in recorded.instances.values():
        core.restore(instance)
    for event in (events.TimePassed(), events.ContactReported(1.0), events.ShutdownOrdered()):
        core.handle(event, clocks.boot_time())
    for instance in core.instances.values():
        messages.encode_status(messages.Status.of(instance, 0.0))
        core.handle(events.FencePassed(instance.key), clocks.boot_time())
    record = instance_record.InstanceRecord(str(state), DISK)
    record.rewrite(core, recorded.launches, recorded.environments, lambda key: 0)
    assert record.trouble == ""


def test_a_deeply_nested_record_is_left_out(tmp_path):
    """The other lines of the record count."""
    good = line(state_fields())
    (tmp_path / "instances.jsonl").write_bytes(DEEP + b"\n" + good)
    recorded = instance_record.read(str(tmp_path))
    assert list(recorded.instances) == [("a", 1)]
    assert len(recorded.notes) == 1


@pytest.mark.parametrize("deadline", [1e300, 3e8])
def test_a_deadline_in_years_does_not_end_the_supervisor(server, tmp_path, deadline):
    """`epoll` waits 24.8 days at most: a longer time-out raised `OverflowError` for good."""
    fields = state_fields(phase="backoff", deadline=deadline)
    (tmp_path / "state").mkdir(mode=0o700)
    header = {"record": "header", "version": 1, "boot": procfs.boot_id()}
    (tmp_path / "state/instances.jsonl").write_bytes(line(header) + line(fields))
    one = server()
    one._take_over()
    assert one._timeout() <= LONGEST_WAIT
    assert one._core.deadline() == deadline


@pytest.mark.parametrize(
    "order",
    [
        start_fields(directory="/a\0b"),
        start_fields(instance=["a\0b", 1]),
        start_fields(argv=["sl\0eep"]),
        start_fields(changes={"A=B": "x"}),
        start_fields(changes={"A": "\ud800"}),
    ],
)
def test_a_process_that_cannot_exist_is_refused_alone(server, order):
    """The supervisor reports the instance as not started, and serves on."""
    one = server()
    one._take_over()
    ours, peer = socket.socketpair()
    with peer:
        talk(one, ours, peer, order)
        deadline = clocks.boot_time() + PATIENCE
        while not (ended := [i for i in one._core.instances.values() if i.phase != "starting"]):
            assert clocks.boot_time() < deadline
            one._round()
            one._take_in(0.1)
        assert ended[0].phase in ("refused", "backoff", "failed")
        assert not one._client.gone


def test_a_reason_names_no_path_of_the_state_directory(server, tmp_path):
    """The master shows it to everybody."""
    one = server()
    one._take_over()
    (tmp_path / "state/work").rmdir()
    (tmp_path / "state/work").touch()
    ours, peer = socket.socketpair()
    with peer:
        talk(one, ours, peer, start_fields())
        while one._core.instances["a", 1].phase == "starting":
            one._round()
            one._take_in(PATIENCE)
    (instance,) = one._core.instances.values()
    assert "'STATE/work' cannot be entered" in instance.message
    assert str(tmp_path) not in instance.message


def talk(server, ours, peer, order):
    """Connect to a server as its client, and send the base environment and an order."""
    environment = {"PATH": os.environ["PATH"]}
    server._listener = type("Listener", (), {"accept": lambda self: (ours, None)})()
    server._accept()
    hello = messages.Hello(messages.PROTOCOL, os.getpid(), LogLimits())
    lines = [messages.encode_order(hello)]
    lines.append(messages.encode_order(messages.Environment("base", environment)))
    peer.sendall(b"".join([*lines, json.dumps(order).encode() + b"\n"]))
    server._take_in(1.0)


def test_a_fault_in_an_order_costs_its_connection_alone(server, monkeypatch):
    """Whatever a line triggers, the supervisor lives on and serves the next client."""
    one = server()
    one._take_over()

    def fail(_):
        raise ZeroDivisionError

    monkeypatch.setattr(one, "_start", fail)
    ours, peer = socket.socketpair()
    with peer:
        talk(one, ours, peer, start_fields())
        one._round()
        peer.settimeout(5.0)
        received = b""
        while part := peer.recv(1 << 16):
            received += part
    assert b"refused" in received.splitlines()[-1]
    assert one._client is None


def test_more_connections_than_descriptors_do_not_end_it(server):
    """`accept` fails while the process has no descriptor left; the next round tries again."""
    one = server()

    def accept(self):
        raise OSError(24, "Too many open files")

    one._listener = type("Listener", (), {"accept": accept})()
    one._accept()


def test_limits_of_logs_are_bounded():
    """A rotation looks at `keep` names: 2^31 of them held up the loop for hours."""
    hello = {"do": "hello", "protocol": 3, "pid": 1, "log": [-1, 2**31, -5, 0]}
    limits = messages.decode_order(json.dumps(hello).encode()).log
    assert limits.max_bytes >= 1
    assert limits.keep <= 1000
    assert limits.instances >= 1
    assert limits.processes >= 1


def test_a_directory_with_a_null_byte_is_a_spawn_error():
    """`os.chdir` raises `ValueError` for it, not `OSError`."""
    with pytest.raises(spawn.SpawnError, match=r"embedded null (byte|character)"):
        executed(spawn.begin(spawn.Program(("true",), {}, "/a\0b"), 0, 1))


def test_a_connection_without_a_free_descriptor_is_closed(server, tmp_path, monkeypatch):
    """Otherwise the loop would find it again in every round, without a wait."""
    its = server()
    peer = endpoint.connect(str(tmp_path / "state"), 1.0)
    refused = [OSError(errno.EMFILE, "Too many open files")]
    listener, monkey = its._listener, SimpleNamespace()

    def accept():
        if refused:
            raise refused.pop()
        return listener.accept()

    monkey.accept = accept
    monkeypatch.setattr(its, "_listener", monkey)
    its._accept()
    assert peer.recv(1) == b""
    assert os.fstat(its._null)
    peer.close()


def test_a_take_over_that_fails_serves_nobody(server, monkeypatch):
    """Otherwise a slave would lose the instances that it missed; another supervisor retries."""

    def fail(*_):
        raise OSError(errno.ENFILE, "Too many open files in system")

    it = server()
    monkeypatch.setattr(takeover, "restore", fail)
    monkeypatch.setattr(it, "_watch_signals", lambda: None)
    monkeypatch.setattr(it, "_round", lambda: pytest.fail("it serves"))
    with pytest.raises(OSError, match="in system"):
        it.run()


def test_a_bug_in_one_start_leaves_no_other_without_an_outcome(server, monkeypatch):
    """Starts are taken from the queue together; each must end, whatever the first one raises."""
    its, failed = server(), []
    monkeypatch.setattr(its, "_spawn", lambda key: 1 // key[1])
    monkeypatch.setattr(its, "_spawn_failed", lambda key, reason, transient: failed.append(key))
    its._spawns.extend([("a", 0), ("b", 1), ("c", 0)])
    its._spawn_some()
    assert failed == [("a", 0), ("c", 0)]
