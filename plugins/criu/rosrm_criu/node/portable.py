"""`PortableNode`: a node that can leave the ROS graph and rejoin it, with its memory intact.

Between departure and rejoin, CRIU may dump the process and restore it on another host.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any, Final

import rclpy.node
from rclpy.event_handler import EventHandler

from rosrm.ros.fast_dds import announcing
from rosrm.ros.graph_remains import close_leaked, open_sockets
from rosrm.ros.peer_announcements import request_announcements
from rosrm_criu.control.messages import VARIABLE
from rosrm_criu.node.graph_departure import Departure, await_peers, await_readers, departure_of

#: Seconds for published samples to reach their readers, before the node leaves.
_READERS: Final = 0.5


class PortableNode(rclpy.node.Node):  # type: ignore[misc]  # rclpy brings no types
    """rclpy's `Node`, able to leave and rejoin the ROS graph; run it with `run_portable`.

    Attributes of the node survive a migration, but ROS entities do not. So create all entities in
    `join` and nowhere else: publishers, subscriptions, timers, services, clients, parameter
    callbacks. Parameters keep their current values.

    Args:
        arguments, named: those of rclpy's node, except `context`.

    Raises:
        TypeError: a `context` was given; a portable node uses the default one.
    """

    def __init__(self, *arguments: Any, **named: Any) -> None:
        if named.get("context") is not None:
            raise TypeError(
                "context: a portable node uses rclpy's default context, which is created again "
                "when it joins; leave it out"
            )
        self._portable_arguments = arguments, named
        self._portable_made: frozenset[int] = frozenset()
        self._portable_declared: tuple[str, ...] = ()
        self._portable_enter(named)
        self._portable_made = frozenset(id(one) for one in self._portable_entities())
        self._portable_given = dict(self._parameter_overrides)

    def join(self) -> None:
        """Create all ROS entities of this node: called at the start, and after each migration."""
        raise NotImplementedError(
            f"{type(self).__name__} has no method join(self): there it makes its publishers, "
            f"subscriptions, timers, services and clients"
        )

    def leave(self) -> None:
        """Release everything that is neither memory nor a ROS entity: devices, sockets, threads.

        Called between two callbacks, before the node leaves; `join` always follows.
        """

    # --- for run_portable ------------------------------------------------------------------

    def _portable_join_first(self) -> None:
        """Join for the first time, after the constructor.

        Raises:
            TypeError: the constructor created an entity that belongs into `join`.
        """
        for entity in self._portable_entities():
            if id(entity) not in self._portable_made:
                raise TypeError(
                    f"{type(self).__name__}.__init__ makes {_described(entity)}: it would be gone "
                    f"after a move. Make it in join(self), which is called at the start, too"
                )
        self._portable_declared = tuple(self.get_parameters_by_prefix(""))
        self.join()

    def _portable_leave(self) -> tuple[Departure, str]:
        """Leave the graph; return the node's state, and the fault of `leave` ("": none)."""
        departure = departure_of(self)
        fault = ""
        try:
            self.leave()
        except Exception as error:  # noqa: BLE001 - the author's code: anything may come
            fault = f"{type(self).__name__}.leave raised {type(error).__name__}: {error}"
        await_readers(self, _READERS)
        self.destroy_node()
        close_leaked(self._portable_sockets)
        return departure, fault

    def _portable_enter_again(self, departure: Departure) -> None:
        """Enter the graph again, with only a name and parameters."""
        named = dict(self._portable_arguments[1])
        # Parameter files may be missing on the new host, so their values are passed as overrides.
        given = [*self._portable_given.values(), *(named.get("parameter_overrides") or ())]
        named["parameter_overrides"] = departure.overrides(given)
        self._portable_enter(named)

    def _portable_join_again(self, departure: Departure) -> None:
        departure.declare_missing(self, self._portable_declared)
        self.join()
        departure.declare_missing(self)

    def _portable_go_on(self, departure: Departure, patience: float) -> tuple[str, ...]:
        """Wait for the peers and start the timers; return the peers that are missing."""
        missing = await_peers(self, departure.peers, patience)
        departure.start_timers(self)
        return missing

    def _portable_enter(self, named: dict[str, Any]) -> None:
        controlled = VARIABLE in os.environ
        # Shared memory of a participant would be dumped with the process; UDP leaves nothing.
        profile = announcing(os.environ, "steady", udp=True)
        before = open_sockets()
        with profile if controlled else contextlib.nullcontext():
            super().__init__(*self._portable_arguments[0], **named)
        self._portable_sockets = {
            number: one for number, one in open_sockets().items() if before.get(number) != one
        }
        if controlled:
            request_announcements(self.context.get_domain_id(), os.environ)

    def _portable_entities(self) -> Iterator[Any]:
        for kind in ("publishers", "subscriptions", "timers", "services", "clients", "guards"):
            yield from getattr(self, kind)
        yield from self.waitables

    def destroy_node(self) -> None:
        """Destroy the node, and its action servers and clients, which would keep the node alive."""
        for waitable in list(self.waitables):
            destroy = getattr(waitable, "destroy", None)
            # Event handlers end with their publishers; an author's own may lack `destroy`.
            if destroy is not None and not isinstance(waitable, EventHandler):
                destroy()
        super().destroy_node()


def _described(entity: Any) -> str:
    """Describe an entity in the user's terms."""
    name = getattr(entity, "topic_name", "") or getattr(entity, "srv_name", "")
    kind = type(entity).__name__.lower()
    return f"a {kind} of {name}" if name else f"a {kind}"
