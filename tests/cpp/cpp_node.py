"""A migratable node by the core of `rosrm_node_cpp`, with rclpy in place of rclcpp.

Every decision and every byte of the handoff protocol is the C++ code's. This module only creates
ROS entities and passes messages on: it does what `src/node.cpp` does by rclcpp, which no test can
run, and imports nothing of `rosrm.node`.
"""

from __future__ import annotations

import ctypes
import itertools
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import rclpy.node
from rcl_interfaces.msg import ParameterEvent
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message

from rosrm_msgs.msg import Sealed
from tests.cpp.core_library import VARIABLE, calls_of, loaded

#: Topics of rclpy itself.
_INTERNAL: Final = frozenset({"/parameter_events", "/clock", "/rosout"})
_FOREVER: Final = 2**63 - 1


def latched(depth: int) -> QoSProfile:
    return QoSProfile(
        depth=depth, reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )  # fmt: skip


def type_name(message_type: Any) -> str:
    package, kind = message_type.__module__.split(".")[:2]
    return f"{package}/{kind}/{message_type.__name__}"


class _Held:
    """Placeholder for the answer to a request that came during a silence."""

    def __init__(self, request: Any, response: Any) -> None:
        self.request, self.response = request, response


class _Core:
    """The core of one node.

    Args:
        node: the node; `plain` gives access to rclpy's own methods.
        ask_every, early: see `Patience` in handoff_session.hpp.
    """

    def __init__(self, node: Any, plain: Any, ask_every: float, early: float) -> None:
        self._library = loaded(Path(os.environ[VARIABLE]))
        self._node, self._plain = node, plain
        self._numbers = itertools.count(1)
        self._entities: dict[int, Any] = {}
        self._tickets: dict[int, tuple[Callable[[], Any], Any]] = {}
        self._raised: BaseException | None = None
        self._wake_timer: Any = None
        self.inputs: list[Any] = []
        self.outputs: list[Any] = []
        self.timers: list[Any] = []
        self.openings: list[Any] = []
        self.parts: list[tuple[Any, Callable[[], Any], Callable[[Any], None]]] = []
        self._calls = calls_of(self._functions())
        environment = [f"{key}={value}".encode() for key, value in os.environ.items()]
        variables = (ctypes.c_char_p * (len(environment) + 1))(*environment, None)
        self._handle = self._library.node_new(
            variables, ctypes.byref(self._calls), ctypes.c_double(ask_every), ctypes.c_double(early)
        )
        error = self._library.bridge_error()
        if not self._handle and error:
            raise ValueError(error.decode())

    @property
    def is_there(self) -> bool:
        """Return True if a slave has started this process."""
        return bool(self._handle)

    @property
    def is_active(self) -> bool:
        return self.is_there and self._library.node_mode(ctypes.c_void_p(self._handle)) == 0

    def call(self, name: str, *arguments: Any) -> int:
        """Call a function of the node; raise what the author's callback raised."""
        result: int = getattr(self._library, name)(ctypes.c_void_p(self._handle), *arguments)
        if result < 0:
            raised, self._raised = self._raised, None
            if raised is not None:
                raise raised
            raise RuntimeError(self._library.bridge_error().decode())
        return result

    def begin(self) -> None:
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._wake_timer = self._plain.create_timer(1.0, self._wake, clock=clock, autostart=False)
        self.call("node_begin")

    def _wake(self) -> None:
        self._wake_timer.cancel()
        self.call("node_wake")

    def close(self) -> None:
        self.call("node_close")
        self._library.node_free(ctypes.c_void_p(self._handle))
        self._handle = None

    def ticket(self, callback: Callable[[], Any], message: Any = None) -> ctypes.c_int64:
        number = next(self._numbers)
        self._tickets[number] = callback, message
        return ctypes.c_int64(number)

    def cycle(self, callback: Callable[[], Any]) -> Any:
        """Run a callback of the author as one cycle, and return its result."""
        results: list[Any] = []
        ticket = self.ticket(lambda: results.append(callback()))
        try:
            self.call("node_cycle", ticket)
        finally:
            self._tickets.pop(ticket.value, None)
        return results[0]

    def arrived(self, function: str, number: int, message: Any, info: Any) -> None:
        callback = self.inputs[number][1]
        ticket = self.ticket(lambda: callback(message), message)
        stamp, order = info["source_timestamp"], info["publication_sequence_number"] or 0
        self.call(function, number, ctypes.c_int64(stamp), ctypes.c_uint64(order), ticket)

    def give(self, data: bytes) -> None:
        self._library.bridge_give(data, ctypes.c_size_t(len(data)))

    def failed(self, error: BaseException) -> int:
        self.give(f"{type(error).__name__}: {error}".encode())
        return -1

    # --- functions that the core calls -----------------------------------------------------

    def _functions(self) -> dict[str, Callable[..., Any]]:
        return {
            "now": time.monotonic,
            "wake_in": self._wake_in,
            "log": self._log,
            "open_writer": self._open_writer,
            "open_reader": self._open_reader,
            "close": self._close,
            "publish": lambda writer, data, size: self._entities[writer].publish(
                ctypes.string_at(data, size)
            ),
            "take": self._take,
            "matched": self._matched,
            "acknowledged": lambda number: self.outputs[number].wait_for_all_acked(Duration()),
            "due": self._due,
            "follows_ros_time": lambda number: bool(
                getattr(self.timers[number].clock, "ros_time_is_active", False)
            ),
            "start_in": lambda number, ns: self.timers[number].start_in(ns),
            "stop": lambda number: self.timers[number].stop(),
            "open": lambda number: self._guarded(self.openings[number].open),
            "close_opening": lambda number: self._guarded(self.openings[number].close),
            "serve_held": lambda number: self._guarded(self.openings[number].serve_held),
            "take_waiting": self._take_waiting,
            "size_of": lambda ticket: len(serialize_message(self._tickets[ticket][1])),
            "serve": lambda ticket: self._guarded(self._tickets[ticket][0]),
            "drop": lambda ticket: self._tickets.pop(ticket, None) and None,
            "save": self._save,
            "restore": self._restore,
        }

    def _guarded(self, callback: Callable[[], Any]) -> int:
        try:
            return int(callback() is True)
        except BaseException as error:  # noqa: BLE001 - the author's code may raise anything
            self._raised = error
            return self.failed(error)

    def _wake_in(self, seconds: float) -> None:
        self._wake_timer.timer_period_ns = max(1, int(seconds * 1e9))
        self._wake_timer.reset()

    def _log(self, severity: int, text: bytes) -> None:
        logger = self._node.get_logger()
        if severity == 0:
            logger.info(text.decode())
        elif severity == 1:
            logger.warning(text.decode())
        else:
            logger.error(text.decode())

    def _open_writer(self, topic: bytes, depth: int) -> int:
        return self._opened(
            lambda _: self._plain.create_publisher(Sealed, topic.decode(), latched(depth))
        )

    def _open_reader(self, topic: bytes, depth: int) -> int:
        def subscribed(number: int) -> Any:
            def take(data: bytes) -> None:
                self.call("node_received", number, data, ctypes.c_size_t(len(data)))

            return self._plain.create_subscription(
                Sealed, topic.decode(), take, latched(depth), raw=True
            )

        return self._opened(subscribed)

    def _opened(self, create: Callable[[int], Any]) -> int:
        number = next(self._numbers)
        try:
            self._entities[number] = create(number)
        except Exception as error:  # noqa: BLE001 - rclpy passes on any error of the middleware
            return self.failed(error)
        return number

    def _close(self, number: int) -> None:
        entity = self._entities.pop(number)
        if isinstance(entity, Publisher):
            self._plain.destroy_publisher(entity)
        else:
            self._plain.destroy_subscription(entity)

    def _take(self, number: int) -> int:
        found = _taken(self._entities[number])
        if found is None:
            return 0
        self.give(found[0])
        return 1

    def _matched(self, is_output: int, number: int) -> int:
        if is_output:
            return int(self.outputs[number].get_subscription_count())
        return int(self.inputs[number][0].get_publisher_count())

    def _due(self, number: int) -> int:
        timer = self.timers[number].timer
        due = None if timer.is_canceled() else timer.time_until_next_call()
        return -1 if due is None else max(0, due)

    def _take_waiting(self, number: int) -> None:
        while (found := _taken(self.inputs[number][0])) is not None:
            self.arrived("node_keep", number, *found)

    def _save(self, number: int) -> int:
        try:
            message = self.parts[number][1]()
        except Exception as error:  # noqa: BLE001 - the author's code may raise anything
            return self.failed(error)
        if message is None:
            return 0
        self.give(serialize_message(message))
        return 1

    def _restore(self, number: int, data: Any, size: int) -> int:
        message_type, _, restore = self.parts[number]
        try:
            restore(deserialize_message(ctypes.string_at(data, size), message_type))
        except Exception as error:  # noqa: BLE001 - the author's code may raise anything
            return self.failed(error)
        return 0


def _content(parameter: Parameter) -> tuple[Any, str]:
    """Return type and value in comparable form."""
    value = parameter.value
    if hasattr(value, "__len__") and not isinstance(value, str):
        value = list(value)
    return parameter.type_, repr(value)


def _taken(subscription: Any) -> Any:
    """Return a waiting message and its information; None: no message waits."""
    with subscription.handle:
        return subscription.handle.take_message(subscription.msg_type, subscription.raw)


class _GatedPublisher(Publisher):  # type: ignore[misc]  # rclpy brings no types
    """A publisher that sends nothing while its node is not active."""

    core: _Core

    def publish(self, msg: Any) -> None:
        if self.core.is_active:
            super().publish(msg)


class _Timer:
    """A timer of the author, which may have a shorter first period."""

    def __init__(self, core: _Core, callback: Callable[[], Any]) -> None:
        self._core, self._callback, self._period = core, callback, 0
        self.timer: Any = None

    def tick(self) -> None:
        if self._core.is_active:
            self._back_in_step()
            self._core.cycle(self._callback)

    def start_in(self, ns: int) -> None:
        self._period = self.timer.timer_period_ns
        self.timer.timer_period_ns = min(ns, self._period)
        self.timer.reset()

    def stop(self) -> None:
        self._back_in_step()
        self.timer.cancel()

    def _back_in_step(self) -> None:
        if self._period:
            self.timer.timer_period_ns, self._period = self._period, 0
            self.timer.reset()

    @property
    def clock(self) -> Any:
        return self.timer.clock


class _Service:
    """A service of the author, which holds the requests of a silence."""

    def __init__(self, core: _Core, create: Any, destroy: Any, callback: Any) -> None:
        self._core, self._create, self._destroy, self._callback = core, create, destroy, callback
        self._service: Any = None
        self._send: Any = None
        self.held: list[tuple[Any, _Held]] = []

    def open(self) -> None:
        self._service = self._create(self._serve)
        self._send, self._service.send_response = self._service.send_response, self._answer

    def _serve(self, request: Any, response: Any) -> Any:
        if not self._core.is_active:
            return _Held(request, response)
        return self._core.cycle(lambda: self._callback(request, response))

    def _answer(self, answer: Any, header: Any) -> None:
        if isinstance(answer, _Held):
            self.held.append((header, answer))
        else:
            self._send(answer, header)

    def serve_held(self) -> bool:
        if not self.held:
            return False
        header, held = self.held.pop(0)
        self._answer(self._serve(held.request, held.response), header)
        return True

    def close(self) -> None:
        self.held.clear()
        self._destroy(self._service)


class _Opening:
    """Another object that exists while the node is active."""

    def __init__(self, create: Callable[[], Any]) -> None:
        self._create, self._made = create, None

    def open(self) -> None:
        self._made = self._create()

    def close(self) -> None:
        getattr(self._made, "destroy", lambda: None)()

    def serve_held(self) -> bool:
        return False


class Node(rclpy.node.Node):  # type: ignore[misc]  # rclpy brings no types
    """The counterpart of `rosrm.node.Node`; `ask_every` and `early` shorten waits of the core."""

    _core: _Core | None = None
    ask_every, early = 10.0, 5.0

    def __init__(self, *arguments: Any, **named: Any) -> None:
        core = _Core(self, super(), self.ask_every, self.early)
        self._core = core if core.is_there else None
        self._own = os.environ.get("ROSRM_NODE", "")
        super().__init__(*arguments, **named)
        if self._core is not None:
            self._keep_parameters()
            self._core.begin()

    def keep_state(self, topic: str, message_type: Any, save: Any, restore: Any) -> None:
        self._keep(topic, message_type, save, restore)

    def _keep(self, topic: str, message_type: Any, save: Any, restore: Any) -> None:
        core = self._core
        if core is not None:
            core.parts.append((message_type, save, restore))
            name = self._visible(topic, self.resolve_topic_name)
            full = name if name.startswith("/") else self.resolve_topic_name(name)
            kind = type_name(message_type).encode()
            core.call("node_keep_state", full.encode(), kind, len(core.parts) - 1)

    def _keep_parameters(self) -> None:
        declared, were_set = set(self._parameters), set()

        def note(parameters: list[Parameter]) -> None:
            names = {one.name for one in parameters}
            were_set.update(names & declared)
            declared.update(names)

        self.add_post_set_parameters_callback(note)

        def save() -> ParameterEvent:
            event = ParameterEvent()
            for one in self._parameters.values():
                was_set = one.name in were_set
                into = event.changed_parameters if was_set else event.new_parameters
                into.append(one.to_parameter_msg())
            return event

        def restore(event: ParameterEvent) -> None:
            theirs = [Parameter.from_parameter_msg(one) for one in event.changed_parameters]
            added = [Parameter.from_parameter_msg(one) for one in event.new_parameters]
            for one in (*added, *theirs):
                if not self.has_parameter(one.name):
                    self.declare_parameter(one.name, one.value)
            differing = [
                one for one in theirs if _content(one) != _content(self._parameters[one.name])
            ]
            result = self.set_parameters_atomically(differing)
            if not result.successful:
                raise ValueError(result.reason)

        self._keep("~/_rosrm/parameters", ParameterEvent, save, restore)

    def when_active(self, create: Callable[[], Any]) -> None:
        if self._core is None:
            create()
        else:
            self._add_opening(_Opening(create), is_service=False)

    def _add_opening(self, opening: Any, *, is_service: bool) -> None:
        core = self._core
        assert core is not None
        core.openings.append(opening)
        core.call("node_add_opening", len(core.openings) - 1, int(is_service))

    def _visible(self, name: str, resolve: Callable[[str], str]) -> str:
        """Return a name without the alias under which this node may run."""
        own = f"{self.get_fully_qualified_name()}/"
        resolved = resolve(name)
        return f"{self._own}/{resolved[len(own) :]}" if resolved.startswith(own) else name

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **named: Any) -> Any:
        core = self._core
        if core is None or topic in _INTERNAL:
            return super().create_publisher(msg_type, topic, qos_profile, **named)
        name = self._visible(topic, self.resolve_topic_name)
        publisher = super().create_publisher(
            msg_type, name, qos_profile, publisher_class=_GatedPublisher, **named
        )
        publisher.core = core
        core.outputs.append(publisher)
        topic_name = publisher.topic_name.encode()
        core.call("node_add_output", topic_name, len(core.outputs) - 1)
        return publisher

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], qos_profile: Any, *,
        buffer: bool = True, **named: Any,
    ) -> Any:  # fmt: skip
        core = self._core
        if core is None or topic in _INTERNAL:
            return super().create_subscription(msg_type, topic, callback, qos_profile, **named)
        number = len(core.inputs)

        def take(message: Any, info: Any) -> None:
            core.arrived("node_input", number, message, info)

        name = self._visible(topic, self.resolve_topic_name)
        subscription = super().create_subscription(msg_type, name, take, qos_profile, **named)
        core.inputs.append((subscription, callback))
        qos = subscription.qos_profile
        wants_all = qos.reliability is not ReliabilityPolicy.BEST_EFFORT and qos.depth > 1
        topic_name = subscription.topic_name.encode()
        core.call("node_add_input", topic_name, number, int(buffer), int(wants_all), qos.depth)
        return subscription

    def create_timer(self, timer_period_sec: float, callback: Any, *rest: Any, **named: Any) -> Any:
        core = self._core
        if core is None or callback is None:
            return super().create_timer(timer_period_sec, callback, *rest, **named)
        timer = _Timer(core, callback)
        timer.timer = super().create_timer(timer_period_sec, timer.tick, *rest, **named)
        core.timers.append(timer)
        core.call("node_add_timer", len(core.timers) - 1)
        return timer.timer

    def create_service(self, srv_type: Any, srv_name: str, callback: Any, **named: Any) -> Any:
        if self._core is None:
            return super().create_service(srv_type, srv_name, callback, **named)
        name = self._visible(srv_name, self.resolve_service_name)
        plain = super()
        create = lambda serve: plain.create_service(srv_type, name, serve, **named)  # noqa: E731
        service = _Service(self._core, create, plain.destroy_service, callback)
        self._add_opening(service, is_service=True)
        return service

    def destroy_node(self) -> None:
        core, self._core = self._core, None
        if core is not None:
            core.close()
        super().destroy_node()

    # --- for tests -------------------------------------------------------------------------

    @property
    def buffered(self) -> int:
        """Number of buffered messages."""
        assert self._core is not None
        return self._core._library.node_buffered(ctypes.c_void_p(self._core._handle))

    @property
    def held_requests(self) -> int:
        """Number of requests that wait for the end of a silence."""
        assert self._core is not None
        services = (one for one in self._core.openings if isinstance(one, _Service))
        return sum(len(one.held) for one in services)

    def hold(self) -> None:
        """Prevent the activation of a destination."""
        assert self._core is not None
        self._core._library.node_hold(ctypes.c_void_p(self._core._handle))
