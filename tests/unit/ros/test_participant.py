"""Loop of a rosrm participant: ready callbacks run as one bounded group."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

from rosrm.errors import Refused
from rosrm.ros.callback_guard import CallbackGuard
from rosrm.ros.participant import Participant
from rosrm_msgs import msg, srv


class Executor:
    """Fake rclpy executor; each turn calls one ready callback.

    Args:
        ready: number of ready callbacks; None: unlimited.
    """

    def __init__(self, ready: int | None) -> None:
        self.ready = ready
        self.turns: list[float] = []

    def spin_once(self, timeout_sec: float) -> None:
        self.turns.append(timeout_sec)
        if self.ready is None or self.ready >= len(self.turns):
            self.callback()


def participant(ready: int | None) -> tuple[Participant, Executor]:
    made = Participant.__new__(Participant)
    made._executed = 0
    made.guard = CallbackGuard()
    made.executor = executor = Executor(ready)
    executor.callback = made.counted(lambda: None)
    return made, executor


def test_all_that_is_ready_is_one_group() -> None:
    """The loop waits for the first callback only, and stops when none is ready."""
    made, executor = participant(ready=3)
    made.spin(7.0)
    assert executor.turns == [7.0, 0.0, 0.0, 0.0]


def test_a_flood_does_not_keep_a_part_from_its_other_work() -> None:
    """A master under continuous requests still sends its beats."""
    made, executor = participant(ready=None)
    began = time.monotonic()
    made.spin(7.0)
    assert time.monotonic() - began < 5.0
    assert len(executor.turns) > 2


class Node:
    """Fake rclpy node that stores the created service."""

    def create_service(self, _kind, _name, _callback, *, qos_profile):
        self.service = SimpleNamespace(send_response=lambda *sent: self.sent.append(sent))
        self.sent = []
        return self.service


def asked(kind, handle, request=None):
    """Return the responses of a handler to one request."""
    made, _ = participant(ready=0)
    made.node = node = Node()
    made.serve(kind, "/service", handle)
    node.service.send_response(request or kind.Request(), "header")
    return [response for response, _ in node.sent]


def test_a_request_whose_handler_raises_is_answered_as_failed(caplog) -> None:
    """The caller need not wait for a time-out; the answer names the error."""

    def handle(_request, _open_request):
        raise Refused("a result is a JSON NoneType, not an object")

    (response,) = asked(srv.Submit, handle)
    assert (response.answer.accepted, response.answer.code) == (False, "failed")
    assert "Refused: a result is a JSON NoneType" in response.answer.message
    assert len(caplog.messages) == 1
    (greeting,) = asked(srv.Handshake, handle)
    assert not greeting.accepted
    assert "not an object" in greeting.message


def test_an_error_of_the_receiver_is_answered_without_its_paths(caplog) -> None:
    """Everybody may ask; the log of the receiver has the text and the place."""

    def handle(_request, _open_request):
        raise OSError(36, "File name too long", "/home/ada/.local/state/rosrm/x")

    (response,) = asked(srv.Submit, handle)
    assert response.answer.message == "an error of the receiver: OSError; its log has the cause"
    assert "/home/ada" in caplog.messages[0]


def test_a_request_that_was_answered_is_not_answered_again(caplog) -> None:
    """An error after the answer is only logged."""

    def handle(_request, open_request):
        open_request.answer(srv.Submit.Response())
        raise Refused("too late")

    assert len(asked(srv.Submit, handle)) == 1
    assert len(caplog.messages) == 1


def test_ctrl_c_in_a_callback_ends_the_loop() -> None:
    """The interrupt is raised in Python code, not through the executor."""
    made, executor = participant(ready=1)

    def interrupted() -> None:
        raise KeyboardInterrupt

    executor.callback = made.counted(interrupted)
    with pytest.raises(KeyboardInterrupt):
        made.spin(1.0)


def test_a_message_beyond_its_bounds_costs_only_itself(caplog) -> None:
    """A request gets an answer that names the field; the callback of a topic is not called."""
    taken: list[object] = []
    made, _ = participant(ready=0)
    callback = made.counted(taken.append)
    for name in ("fine", 65_537 * "n"):
        callback(msg.MasterBeat(name=name))
    assert [one.name for one in taken] == ["fine"]
    assert "MasterBeat.name has 65537 letters; at most 65536" in caplog.text

    def handle(request, open_request):
        raise AssertionError("a request beyond its bounds was handled")

    request = srv.Cancel.Request(processes=[65_537 * "n"])
    (response,) = asked(srv.Cancel, handle, request)
    assert (response.answer.accepted, response.answer.code) == (False, "failed")
    assert "Cancel_Request.processes has 65537 letters" in response.answer.message
