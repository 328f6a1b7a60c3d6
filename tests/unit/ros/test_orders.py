"""Orders of the master as requests, and as events of the slave's core."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import get_args

import pytest

from rosrm.core.slave import events as happened
from rosrm.core.slave.orders import event_of, why_stale
from rosrm.errors import Refused
from rosrm.model.links import LinkPeer
from rosrm.model.orders import (
    AmendInstance,
    DropReplica,
    FenceInstance,
    MeasureLinks,
    Order,
    ReloadSettings,
    ReplicateSnapshot,
    ReportInstances,
    RestartInstance,
    RunExecutor,
    SetLifecycleState,
    StartInstance,
    StopInstance,
)
from rosrm.model.values import (
    Amendment,
    Assignment,
    InstanceId,
    Limits,
    ProcessSpec,
    RestartPolicy,
    Run,
)
from rosrm.ros.orders import journal_of, order_from_msg, order_to_msg, start_to_msg
from rosrm_msgs import srv

ONE = InstanceId("p", 7)
POLICY = Amendment(RestartPolicy("always", delay=2.0))
LIMITED = replace(POLICY, limits=Limits(memory=2e9, enforce="required"))
ASSIGNMENT = Assignment(ONE, ProcessSpec("p", command=("true",)), epoch=3, node_name="p")
EVENTS = [
    (StartInstance(ASSIGNMENT), happened.AssignmentsReceived((ASSIGNMENT,), 5.0)),
    (StopInstance(ONE), happened.StopOrdered(ONE)),
    (FenceInstance(ONE), happened.FenceOrdered(ONE)),
    (RestartInstance(ONE), happened.RestartOrdered(ONE)),
    (RestartInstance(ONE, Run(5, 2)), happened.RestartOrdered(ONE, Run(5, 2))),
    (AmendInstance(ONE, POLICY), happened.AmendmentOrdered(ONE, POLICY)),
    (AmendInstance(ONE, LIMITED), happened.AmendmentOrdered(ONE, LIMITED)),
    (SetLifecycleState(ONE, "inactive"), happened.LifecycleOrdered(ONE, "inactive")),
    (ReportInstances(), happened.ReportRequested()),
]
ORDERS = [
    *(order for order, _ in EVENTS),
    MeasureLinks((LinkPeer(2, "b", ("10.0.0.2",), 4000, b"k" * 32),), learn=True),
    RunExecutor("criu_dump", {"of": 7, "to": ["b"]}, 2.5),
    ReplicateSnapshot(ONE, ("b", "c"), 0.5),
    DropReplica(ONE),
    ReloadSettings(),
]


def test_every_order_is_tried_below():
    assert {type(order) for order in ORDERS} == set(get_args(Order))


@pytest.mark.parametrize("order", ORDERS, ids=lambda order: type(order).__name__)
def test_a_slave_that_is_not_registered_executes_only_orders_to_end_an_instance(order):
    """The slave may not know its instances yet, nor the master this run of the slave."""
    ends = isinstance(order, StopInstance | FenceInstance)
    assert bool(why_stale(order, registered=False)) is not ends
    assert not why_stale(order, registered=True)


@pytest.mark.parametrize("order", ORDERS, ids=lambda order: type(order).__name__)
def test_an_order_is_the_same_after_its_way_to_the_slave(order):
    assert order_from_msg(order_to_msg(order)) == order


def test_no_field_of_an_order_is_in_the_next_one():
    """All orders are copies of one empty request."""
    for order in ORDERS:
        order_to_msg(order)
    empty = srv.ControlHost.Request(action=srv.ControlHost.Request.REPORT)
    assert order_to_msg(ReportInstances()) == empty


@pytest.mark.parametrize("seconds", [float("nan"), float("inf"), -1.0, 4e8])
@pytest.mark.parametrize("order", [ORDERS[-4], ORDERS[-3]], ids=["timeout", "replicate_every"])
def test_an_order_with_a_time_that_never_ends_is_refused(order, seconds):
    request = order_to_msg(order)
    request.timeout = request.replicate_every = seconds
    with pytest.raises(Refused, match="allowed: 0 to"):
        order_from_msg(request)


@pytest.mark.parametrize(("order", "event"), EVENTS, ids=lambda one: type(one).__name__)
def test_an_order_for_the_core_becomes_its_event(order, event):
    assert event_of(order, 5.0) == event


def test_a_start_has_the_watermark_of_the_journal():
    """A START that no assignment caused has none, which reads as 0."""
    start = StartInstance(ASSIGNMENT)
    request = start_to_msg(start, 41)
    assert (journal_of(request), order_from_msg(request)) == (41, start)
    assert journal_of(order_to_msg(start)) == 0


@pytest.mark.parametrize("arguments", ['{"journal": -1}', '{"journal": true}', "[41]", "{"])
def test_an_invalid_watermark_is_refused(arguments):
    with pytest.raises(Refused):
        journal_of(srv.ControlHost.Request(arguments=arguments))


@pytest.mark.parametrize("run", ['{"pid": 5}', '{"pid": -1, "restarts": 0}', "[5, 0]", "{"])
def test_a_restart_of_an_impossible_run_is_refused(run):
    action = srv.ControlHost.Request.RESTART
    with pytest.raises(Refused):
        order_from_msg(srv.ControlHost.Request(action=action, arguments=run))


def test_an_unknown_action_is_refused():
    """A newer master may send one."""
    with pytest.raises(Refused, match="unknown action 99"):
        order_from_msg(srv.ControlHost.Request(action=99))


@pytest.mark.parametrize(
    "order",
    [
        RunExecutor("criu_dump", {}, float("nan")),
        RunExecutor("criu_dump", {}, 1e300),
        ReplicateSnapshot(ONE, ("b",), float("inf")),
        ReplicateSnapshot(ONE, ("../b",), 0.5),
        StopInstance(InstanceId("p\x1b[2J", 7)),
    ],
    ids=str,
)
def test_an_order_with_an_impossible_name_or_time_is_refused(order):
    """The time would never pass, and the name would become a part of files and logs."""
    with pytest.raises(Refused):
        order_from_msg(order_to_msg(order))


@pytest.mark.parametrize(
    "changes",
    [
        {"host_id": 0}, {"host_id": "x"}, {"host": "../b"}, {"addresses": ["b.example"]},
        {"addresses": 5}, {"port": 70000}, {"key": "zz"}, {"key": "00" * 33},
    ],
)  # fmt: skip
def test_an_order_with_an_impossible_peer_is_refused(changes):
    """No packet is sent to such a peer."""
    peer = {"host_id": 2, "host": "b", "addresses": ["10.0.0.2"], "port": 4000, "key": ""}
    request = order_to_msg(MeasureLinks())
    request.arguments = json.dumps({"peers": [{**peer, **changes}], "learn": False})
    with pytest.raises(Refused, match="an order to measure links"):
        order_from_msg(request)


def test_an_order_for_an_unknown_lifecycle_state_is_refused():
    request = order_to_msg(SetLifecycleState(ONE, "active"))
    request.lifecycle = "finalized"
    with pytest.raises(Refused, match="'finalized'; allowed: active, inactive"):
        order_from_msg(request)
