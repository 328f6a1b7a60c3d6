"""Conversion of values to messages and back; invalid messages are refused."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

from rosrm.errors import Refused
from rosrm.model import values
from rosrm.model.adoption import Adoption
from rosrm.model.rows import EventRow, HostRow, PluginRow, ProcessRow, ResourceRow
from rosrm.ros import control, convert
from rosrm.ros.bounds import check_bounds
from rosrm_msgs import msg
from tests.drawing import PRINTABLE, SPECS, drawn

#: A fence of 0 s is none.
FENCES = drawn(values.Fence, after=st.floats(1e-3, 1e6))


def over_the_wire(message):
    """Serialise and deserialise a message."""
    return deserialize_message(serialize_message(message), type(message))


def survives(value, name: str) -> bool:
    """Return True if a value is received unchanged in every field."""
    message = getattr(convert, f"{name}_to_msg")(value)
    return getattr(convert, f"{name}_from_msg")(over_the_wire(message)) == value


@given(SPECS)
@settings(max_examples=150, deadline=None)
def test_spec_survives(spec) -> None:
    """A submitted spec is received unchanged, and its restart policy also apart from it."""
    assert survives(spec, "spec")
    assert survives(spec.restart, "restart")


def test_an_adoption_survives() -> None:
    """The slave gets the process that it adopts, with its start time."""
    adoption = Adoption("a", 2**31 - 1, 2**53, "boot")
    spec = values.ProcessSpec("p", command=("true",), adoption=adoption)
    assert survives(spec, "spec")


#: An assignment has a key of 32 bytes, or none.
STATE_KEYS = st.just(b"") | st.binary(min_size=32, max_size=32)


@given(drawn(values.Assignment, spec=SPECS, fence=st.none() | FENCES, state_key=STATE_KEYS))
@settings(max_examples=30, deadline=None)
def test_assignment_survives(assignment) -> None:
    assert survives(assignment, "assignment")


@pytest.mark.parametrize("size", [1, 31, 33])
def test_a_state_key_of_another_length_is_refused(size) -> None:
    spec = values.ProcessSpec("p", command=("true",))
    message = convert.assignment_to_msg(
        values.Assignment(values.InstanceId("p", 1), spec, 1, "p", state_key=bytes(size))
    )
    with pytest.raises(Refused, match=f"p: state_key has {size} bytes; allowed: 0 or 32"):
        convert.assignment_from_msg(message)


def test_the_text_of_an_assignment_has_no_key() -> None:
    """A log line with an assignment shows no key."""
    spec = values.ProcessSpec("p", command=("true",))
    one = values.Assignment(values.InstanceId("p", 1), spec, 1, "p", state_key=b"Q" * 32)
    assert "Q" not in repr(one)
    assert "state_key" not in repr(one)


@pytest.mark.parametrize(
    ("name", "value"), [("when", "sometimes"), ("factor", 0.5), ("delay", -1.0)]
)
def test_restart_policy_that_makes_no_sense_is_refused(name, value) -> None:
    """The policy is refused as a whole."""
    message = convert.restart_to_msg(values.RestartPolicy())
    setattr(message, name, value)
    with pytest.raises(Refused, match="a restart policy: "):
        convert.restart_from_msg(message)


def test_a_status_about_a_path_of_other_bytes_can_be_sent() -> None:
    """A path that is no UTF-8 has surrogates, which ended the slave at the next report."""
    path = b"/opt/caf\xe9/talker".decode(errors="surrogateescape")
    status = values.InstanceStatus(
        values.InstanceId("p", 1), values.InstanceState.FAILED, message=f"no executable {path}"
    )
    message = over_the_wire(convert.status_to_msg(status))
    assert message.message == "no executable /opt/caf?/talker"
    answer = over_the_wire(control.refused("unable", path))
    assert answer.message == "/opt/caf?/talker"


def test_a_host_with_reasons_about_paths_of_other_bytes_can_be_sent() -> None:
    """Limits that are not enforced name a control group, of which the name may have any bytes."""
    group = b"/sys/fs/cgroup/caf\xe9".decode(errors="surrogateescape")
    reason = {"limits.cpu": f"no group below {group}"}
    host = values.HostDescription("robot", 1, absent=reason, unenforced=reason)
    received = convert.host_from_msg(over_the_wire(convert.host_to_msg(host)))
    assert received.unenforced == {"limits.cpu": "no group below /sys/fs/cgroup/caf?"}
    assert received.absent == received.unenforced


@given(drawn(values.InstanceStatus))
@settings(max_examples=60, deadline=None)
def test_status_survives(status) -> None:
    """A status is received by the master as the slave sent it."""
    assert survives(status, "status")


HOSTS = drawn(
    values.HostDescription,
    resources=st.lists(
        drawn(values.ResourceDescription, unit=PRINTABLE, scope=PRINTABLE),
        max_size=16, unique_by=lambda resource: resource.name,
    ).map(tuple),
    labels=st.dictionaries(PRINTABLE, PRINTABLE, max_size=3),
    absent=st.dictionaries(PRINTABLE, PRINTABLE, max_size=3),
    unenforced=st.dictionaries(PRINTABLE, PRINTABLE, max_size=3),
    executors=st.lists(PRINTABLE, max_size=3).map(tuple),
    hostname=PRINTABLE, software_version=PRINTABLE,
)  # fmt: skip


@given(HOSTS)
@settings(max_examples=60, deadline=None)
def test_host_survives(host) -> None:
    """A host description is received unchanged; a resource's position is its slot."""
    assert survives(host, "host")


@given(HOSTS, st.data())
@settings(max_examples=30, deadline=None)
def test_host_row_survives(host, data) -> None:
    """A row of `rosrm hosts` is received whole, without digits added by float32."""
    fraction = st.integers(0, 2_000_000).map(lambda number: number / 1e6)
    row = HostRow(
        host, 7, "up", True, False, True, 0.25,
        tuple(
            ResourceRow(r.name, r.unit, r.capacity, r.scope, data.draw(fraction),
                        data.draw(fraction), data.draw(fraction), data.draw(st.booleans()))
            for r in host.resources
        ),
        3, data.draw(st.booleans()),
    )  # fmt: skip
    assert survives(row, "host_row")


def test_a_host_row_with_a_reading_too_few_is_refused() -> None:
    """A false master could otherwise end `rosrm hosts` with a traceback."""
    message = msg.HostState(
        description=msg.HostDescription(name="a", resources=[msg.ResourceDescription()])
    )
    with pytest.raises(Refused, match="its readings do not fit its resources"):
        convert.host_row_from_msg(message)


def test_rows_survive() -> None:
    """Rows of `ps`, `plugins` and `events` are received whole."""
    process = ProcessRow(
        "a",
        "job",
        "failed",
        "h",
        2**40,
        12,
        3,
        1,
        -9,
        -5,
        0,
        1.5,
        0.9,
        2**40,
        "why",
        True,
        "user:ada",
        1.5,
        2**40,
    )
    plugin = PluginRow("probe", "gpu", "rosrm-resources 0.1", "absent", "no driver", "h")
    event = EventRow(2**40, 1.7e9, 12.5, "assigned", "a", "h", "a goes to h", {"n": [1, {"x": 2}]})
    for row in (process, replace(process, exit_code=None), replace(process, exit_code=0)):
        assert survives(row, "process_row")
    assert survives(plugin, "plugin_row")
    assert survives(event, "event")


def amount(of: float) -> list[msg.ResourceAmount]:
    return [msg.ResourceAmount(resource="memory", amount=of)]


def value(text: str) -> list[msg.KeyValue]:
    return [msg.KeyValue(key="a", value=text)]


def neighbour(**fields: object) -> list[msg.NeighbourRule]:
    return [msg.NeighbourRule(**{"relation": "near", "processes": ["q"], **fields})]


def pair(key: str, text: str) -> msg.KeyValue:
    return msg.KeyValue(key=key, value=text)


NAN, INF = float("nan"), float("inf")


def asked(**fields):
    return [msg.DeviceNeed(**{"kind": "gpu", "amount": 1.0, **fields})]


def variable(name: str, value: str) -> list[msg.KeyValue]:
    return [msg.KeyValue(key=name, value=value)]


NONSENSE_IN_SPECS = {
    "no name": lambda m: setattr(m, "name", ""),
    "a name with an escape": lambda m: setattr(m, "name", "p\x1b[2J"),
    "a name of two lines": lambda m: setattr(m, "name", "p\nq"),
    "a long name": lambda m: setattr(m, "name", 201 * "p"),
    "a path as a name": lambda m: setattr(m, "name", "../p"),
    "a namespace": lambda m: setattr(m, "ros_namespace", "/a b"),
    "a long namespace": lambda m: setattr(m, "ros_namespace", 256 * "/a"),
    "a long argument": lambda m: setattr(m, "arguments", [131_073 * "x"]),
    "long arguments": lambda m: setattr(m, "arguments", 10 * [131_000 * "x"]),
    "many arguments": lambda m: setattr(m, "arguments", 65_537 * [""]),
    "too much of a resource": lambda m: setattr(m, "needs", amount(1e300)),
    "a delay of centuries": lambda m: setattr(m.restart, "delay", 1e10),
    "a grace of centuries": lambda m: setattr(m.stop, "interrupt_grace", 1e10),
    "a factor of millions": lambda m: setattr(m.restart, "factor", 1e7),
    "two forms": lambda m: setattr(m, "module", "x"),
    "no form": lambda m: setattr(m, "command", []),
    "an executable without a package": lambda m: setattr(m, "executable", "x"),
    "kind": lambda m: setattr(m, "kind", "daemon"),
    "restart": lambda m: setattr(m.restart, "when", "sometimes"),
    "a delay that is no time": lambda m: setattr(m.restart, "delay", NAN),
    "an endless bound": lambda m: setattr(m.restart, "max_delay", INF),
    "a falling back-off": lambda m: setattr(m.restart, "factor", 0.5),
    "a negative window": lambda m: setattr(m.restart, "window", -1.0),
    "readiness": lambda m: setattr(m.readiness, "kind", "soon"),
    "a readiness without end": lambda m: setattr(m.readiness, "timeout", NAN),
    "a grace without end": lambda m: setattr(m.stop, "interrupt_grace", INF),
    "a time limit without end": lambda m: setattr(m, "time_limit", NAN),
    "a delay before another host": lambda m: setattr(m.reschedule, "delay", -1.0),
    "a loss of centuries": lambda m: setattr(m.host_loss, "delay", 1e9),
    "an isolation of centuries": lambda m: setattr(m.isolation, "after", 1e9),
    "a component of no ROS node": lambda m: m.components.append(msg.Component(name="c")),
    "a lifecycle": lambda m: setattr(m.lifecycle, "autostart", "on"),
    "a lifecycle of no ROS node": lambda m: setattr(m.lifecycle, "autostart", "active"),
    "a transition without end": lambda m: setattr(m.lifecycle, "timeout", INF),
    "a rate without end": lambda m: setattr(m.health, "rate", INF),
    "a negative grace": lambda m: setattr(m.stop, "terminate_grace", -1.0),
    "needs": lambda m: setattr(m, "needs", amount(NAN)),
    "negative needs": lambda m: setattr(m, "needs", amount(-1.0)),
    "a parameter": lambda m: setattr(m, "parameters", value("{")),
    "a parameter too deep": lambda m: setattr(m, "parameters", value("[" * 100_000)),
    "migration options": lambda m: setattr(m.migration, "options", "[1]"),
    "options too deep": lambda m: setattr(m.migration, "options", '{"a":' * 100_000),
    "a limit": lambda m: setattr(m.limits, "memory", NAN),
    "an enforcement": lambda m: setattr(m.limits, "enforce", "maybe"),
    "a policy": lambda m: setattr(m.realtime, "policy", "deadline"),
    "a niceness": lambda m: setattr(m, "nice", 100),
    "a CPU twice": lambda m: setattr(m, "cpus", [1, 1]),
    "an end of a group": lambda m: setattr(m.group, "ends", "sometimes"),
    "a group that is a path": lambda m: setattr(m.group, "name", "../g"),
    "a gang that is a path": lambda m: setattr(m, "together", "../g"),
    "a relation": lambda m: setattr(m, "neighbours", neighbour(relation="above")),
    "a rule about none": lambda m: setattr(m, "neighbours", neighbour(processes=[])),
    "a rule about both": lambda m: setattr(m, "neighbours", neighbour(group="g")),
    "a neighbour that is a path": lambda m: setattr(m, "neighbours", neighbour(processes=["../q"])),
    "a flow to itself": lambda m: setattr(m, "talks_to", [msg.ProcessFlow(process=m.name)]),
    "a flow to a path": lambda m: setattr(m, "talks_to", [msg.ProcessFlow(process="../q")]),
    "a flow that is no number": lambda m: setattr(
        m, "talks_to", [msg.ProcessFlow(process="q", rate=float("nan"))]
    ),
    "a secret in a relative file": lambda m: setattr(m, "secrets", variable("TOKEN", "token")),
    "a secret that is also a variable": lambda m: (
        setattr(m, "secrets", variable("TOKEN", "/t")),
        setattr(m, "environment", variable("TOKEN", "x")),
    ),
    "an adoption of nothing": lambda m: setattr(m.adoption, "host", "a"),
    "an adoption of the first process": lambda m: setattr(
        m, "adoption", msg.Adoption(host="a", pid=1, birth=1, boot="b")
    ),
    "an engine without an image": lambda m: setattr(m.container, "engine", "podman"),
    "an option as an image": lambda m: setattr(
        m, "container", msg.Container(image="-v", engine="x")
    ),
    "many secrets": lambda m: setattr(m, "secrets", variable("TOKEN", "/t") * 257),
    "many flows": lambda m: setattr(m, "talks_to", [msg.ProcessFlow(process="q")] * 257),
    "many neighbours": lambda m: setattr(m, "neighbours", neighbour() * 257),
    "a start after itself": lambda m: setattr(m.start_order, "after", [pair("p", "ready")]),
    "a start after a path": lambda m: setattr(m.start_order, "after", [pair("../q", "ready")]),
    "a condition": lambda m: setattr(m.start_order, "after", [pair("q", "started")]),
    "many starts": lambda m: setattr(m.start_order, "after", [pair("q", "ready")] * 257),
    "a start without end": lambda m: setattr(m.start_order, "delay", NAN),
    "a restart with others": lambda m: setattr(m.start_order, "on_restart", "perhaps"),
    "a device of no kind": lambda m: setattr(m, "devices", asked(kind="")),
    "a share that is no number": lambda m: setattr(m, "devices", asked(amount=NAN)),
    "a share of two units": lambda m: setattr(m, "devices", asked(amount=1.5)),
    "units and another number": lambda m: setattr(m, "devices", asked(units=["a", "b"])),
    "a unit twice": lambda m: setattr(m, "devices", asked(amount=2.0, units=["a", "a"])),
    "a kind twice": lambda m: setattr(m, "devices", asked() * 2),
}


def test_the_paths_of_given_fields_are_sent() -> None:
    """They do not count in a comparison of two specs, because they are not part of the process."""
    spec = values.ProcessSpec("p", command=("true",), given=("name", "restart.when"))
    assert convert.spec_from_msg(convert.spec_to_msg(spec)).given == spec.given


def received_spec(message):
    """Return the spec in a message, as a receiver does."""
    check_bounds(message)
    return convert.spec_from_msg(message)


@pytest.mark.parametrize("what", NONSENSE_IN_SPECS)
def test_spec_that_makes_no_process_is_refused(what) -> None:
    """Any client may send an invalid spec: the refusal has a reason, and nothing else is raised."""
    sent = convert.spec_to_msg(values.ProcessSpec("p", command=("true",)))
    convert.spec_from_msg(sent)
    message = deepcopy(sent)  # its policies are those of other specs, too

    NONSENSE_IN_SPECS[what](message)

    with pytest.raises(Refused) as refusal:
        received_spec(message)
    assert len(str(refusal.value)) < 500


NONSENSE_IN_HOSTS = {
    "no name": lambda m: setattr(m, "name", ""),
    "a name with an escape": lambda m: setattr(m, "name", "h\x9b2J"),
    "a label with an escape": lambda m: setattr(
        m, "labels", [msg.KeyValue(key="a", value="\x1b[2J")]
    ),
    "a period of hours": lambda m: setattr(m, "period", 1e300),
    "no period": lambda m: setattr(m, "period", NAN),
    "no incarnation": lambda m: setattr(m, "incarnation", 0),
    "a slot twice": lambda m: setattr(m.resources[1], "slot", 0),
    "a hole": lambda m: setattr(m.resources[1], "slot", 5),
    "capacity": lambda m: setattr(m.resources[0], "capacity", NAN),
    "no capacity": lambda m: setattr(m.resources[0], "capacity", 0.0),
    "too many": lambda m: setattr(
        m, "resources",
        [msg.ResourceDescription(slot=n, name=str(n), capacity=1.0) for n in range(17)],
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", NONSENSE_IN_HOSTS)
def test_host_that_makes_no_sense_is_refused(what) -> None:
    """A slave with an invalid description cannot register."""
    resources = tuple(values.ResourceDescription(name, "B", 1.0) for name in ("memory", "disk"))
    message = convert.host_to_msg(values.HostDescription("h", 1, resources=resources))
    convert.host_from_msg(message)

    NONSENSE_IN_HOSTS[what](message)

    with pytest.raises(Refused):
        convert.host_from_msg(message)


def test_unknown_state_is_refused() -> None:
    """A status of a state unknown to this version is refused."""
    with pytest.raises(Refused, match="flying"):
        convert.status_from_msg(msg.ProcessStatus(state="flying"))


@pytest.mark.parametrize(
    ("field", "value"),
    [("peak_memory", 1e300), ("cpu_time", INF), ("run_time", 1e10), ("run_time", NAN)],
)
def test_status_with_an_absurd_value_is_refused(field, value) -> None:
    message = msg.ProcessStatus(state="exited", instance=msg.InstanceId(process="p", number=1))
    setattr(message, field, value)
    with pytest.raises(Refused, match=field):
        convert.status_from_msg(message)


@pytest.mark.parametrize("name", ["", "p\x1b[2J", 201 * "p"])
def test_reports_of_improper_names_are_refused(name) -> None:
    """The name of a process becomes a part of topics and files."""
    with pytest.raises(Refused, match="cannot be the name of a process"):
        convert.status_from_msg(
            msg.ProcessStatus(state="exited", instance=msg.InstanceId(process=name))
        )
    with pytest.raises(Refused, match="cannot be the name of a process"):
        convert.snapshot_from_msg(msg.SnapshotReport(process=name))


def test_control_characters_in_a_reason_are_replaced() -> None:
    """The lines stay, because listings show the first one."""
    message = msg.ProcessStatus(
        state="failed", instance=msg.InstanceId(process="p", number=1),
        message="no \x1b[31mcolour\tthere\r\nsecond\x9b",
    )  # fmt: skip
    assert convert.status_from_msg(message).message == "no ?[31mcolour there \nsecond?"


def test_long_texts_for_users_are_cut_by_their_sender() -> None:
    """The receiver would refuse the whole message."""
    status = values.InstanceStatus(
        values.InstanceId("p", 1), values.InstanceState.FAILED, message=100_000 * "x"
    )
    assert len(convert.status_to_msg(status).message) == 65_536


@pytest.mark.parametrize("text", ["[1]", "1", "nothing", "{", '"a"', "null"])
def test_only_a_json_object_is_one(text) -> None:
    """The refusal of any other value names its type."""
    with pytest.raises(Refused, match="the options"):
        convert.json_object(text, "the options")
    assert convert.json_object("", "the options") == {}


@pytest.mark.parametrize(
    "held", [{"share": NAN}, {"share": 0.0}, {"share": 1.5}, {"kind": ""}, {"unit": "../x"}]
)
def test_a_held_device_that_is_none_is_refused(held) -> None:
    """A slave cannot hold more than a unit, and a master cannot assign it."""
    device = msg.HeldDevice(**{"kind": "gpu", "unit": "0", "share": 1.0, **held})
    status = values.InstanceStatus(values.InstanceId("p", 1), values.InstanceState.READY)
    message = convert.status_to_msg(status)
    message.devices = [device]
    with pytest.raises(Refused, match="'p': "):
        convert.status_from_msg(message)


@pytest.mark.parametrize(
    "wrong", [{"shareable": 0}, {"path": "video0"}, {"about": "\x1b"}, {"kind": "a b"}]
)
def test_a_host_with_a_device_that_is_none_is_refused(wrong) -> None:
    """Also in a later report of its devices."""
    device = msg.Device(**{"kind": "gpu", "unit": "0", "shareable": 1, **wrong})
    with pytest.raises(Refused):
        convert.devices_from_msg([device])
    message = convert.host_to_msg(values.HostDescription("h", 1))
    message.devices = [device]
    with pytest.raises(Refused, match="h has devices that no host can have: "):
        convert.host_from_msg(message)
