"""One DDS participant with one node and one executor: all ROS entities of a rosrm component.

The EventsExecutor costs a third of the others' CPU per message, but its `spin()` does nothing in
the Jazzy wheels. So this module loops over `spin_once`. The executor cannot await an asynchronous
service callback. So `serve` defers every response, and a request may stay open until its answer.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import rclpy.serialization  # for `rosrm.ros.cdr`, which may run while no file can be opened
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from rosrm import clocks
from rosrm.model.ros_settings import RosSettings
from rosrm.ros import qos
from rosrm.ros.callback_guard import CallbackGuard
from rosrm.ros.fast_dds import Pace, announcing_part, bound
from rosrm.ros.network_interface import check_interface
from rosrm.runtime.timer_slack import use_exact_timers

if TYPE_CHECKING:
    from typing_extensions import Self


#: Held while a participant is created, because Fast DDS reads the environment, which all threads
#: share; otherwise one of two participants has no profile.
_CREATION: Final = threading.Lock()
#: Seconds after which `spin` returns although messages still arrive.
_FLOOD: Final = 0.05


@dataclass(slots=True)
class OpenRequest:
    """A request that waits for its response; `answer` may be called once, at any time."""

    _send: Callable[[Any, Any], None]
    _header: Any

    def answer(self, response: Any) -> None:
        """Send the response."""
        self._send(response, self._header)


class Participant:
    """A context, a minimal node and its executor.

    Args:
        settings: applied to the environment before the context is created.
        name: of the node.
        pace: frequency of DDS announcements: "eager" or "steady" (docs/decisions/0009).

    Attributes:
        created_at: monotonic time of the join, in seconds.
        guard: calls every callback of ROS.
    """

    def __init__(self, settings: RosSettings, name: str, *, pace: Pace = "eager") -> None:
        settings.check()
        os.environ.update(settings.environment())
        self.settings = settings
        self.context = rclpy.Context()
        interface = settings.interface_in_force()
        if interface:
            check_interface(interface)
            profile = bound(os.environ, pace, interface)
        else:
            profile = announcing_part(os.environ, pace)
        with _CREATION, profile:
            # Without the logging of ROS, which would leave an empty file for each command. Unlike
            # `rclpy.init`, this installs no signal handlers.
            self.context.init(domain_id=settings.domain, initialize_logging=False)
            self.node = self._lean_node(name)
        self.created_at = clocks.boot_time()
        use_exact_timers()
        self.executor = EventsExecutor(context=self.context)
        self.executor.add_node(self.node)
        self._executed = 0
        self.guard = CallbackGuard()
        self._unwatched: list[Node] = []

    def _lean_node(self, name: str) -> Node:
        return Node(
            name,
            context=self.context,
            namespace=self.settings.namespace,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
            parameter_overrides=[Parameter("start_type_description_service", value=False)],
        )

    def unwatched_node(self, name: str) -> Node:
        """Return a node of the same participant outside the executor; its messages are polled."""
        node = self._lean_node(name)
        self._unwatched.append(node)
        return node

    # --- the loop ------------------------------------------------------------------------

    def counted(self, callback: Callable[..., None]) -> Callable[..., None]:
        """Wrap a callback: `spin` counts its calls to notice activity, and it raises nothing.

        A message of rosrm that exceeds its bounds is dropped, as one whose callback raises.
        """
        # Imported only here: all messages and numpy take longer than the discovery of a peer, and
        # a command creates its participant first, so that both run in parallel.
        from rosrm.ros.bounds import call_bounded  # noqa: PLC0415

        def call(*arguments: Any) -> None:
            self._executed += 1
            self.guard.call(call_bounded, callback, *arguments)

        return call

    def spin(self, timeout: float) -> bool:
        """Wait for an event, at most `timeout` seconds, then handle all that are ready.

        Continuous events end it after `_FLOOD` seconds, because periodic work must not wait longer.
        Return True if a callback was called.
        """
        first = before = self._executed
        self.executor.spin_once(timeout_sec=timeout)
        flooded = clocks.boot_time() + _FLOOD
        while self._executed != before and clocks.boot_time() < flooded:
            before = self._executed
            self.executor.spin_once(timeout_sec=0.0)
        self.guard.raise_interrupt()
        return self._executed != first

    def post(self, callback: Callable[..., None], *arguments: Any) -> None:
        """Call a callback in the loop, as that of a message; may be called from any thread."""
        self.executor.create_task(self.counted(callback), *arguments)

    def wake(self) -> None:
        """End a waiting `spin`; may be called from any thread."""
        self.executor.create_task(_nothing)

    # --- services ------------------------------------------------------------------------

    def serve(
        self, service_type: Any, name: str, handle: Callable[[Any, OpenRequest], None]
    ) -> None:
        """Offer a service with deferred responses.

        `handle` is called with each request and the means to answer it. If it raises, the request
        is not answered, so that a stranger learns nothing.
        """
        # The executor passes the callback's result to `send_response` with the header that an
        # answer needs. So the callback returns the request, and `take` receives both.
        service = self.node.create_service(
            service_type, name, lambda request, _response: request, qos_profile=qos.SERVICE
        )
        send = service.send_response

        def take(request: Any, header: Any) -> None:
            self._executed += 1
            self.guard.call(handle, request, OpenRequest(send, header))

        service.send_response = take

    def close(self) -> None:
        """Destroy nodes, executor and context."""
        self.executor.remove_node(self.node)
        self.executor.shutdown()
        for node in (*self._unwatched, self.node):
            node.destroy_node()
        self.context.try_shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _nothing() -> None:
    """Do nothing; running it ends a waiting `spin_once`, which the executor's `wake` does not."""
