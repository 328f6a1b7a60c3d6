"""`Node`: rclpy's node, for processes that rosrm can move with their state."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import rclpy.node

from rosrm.node.entities import ServiceOf
from rosrm.node.handoff.session import Handoff
from rosrm.node.identity import Identity, identity_from
from rosrm.ros.fast_dds import announcing

if TYPE_CHECKING:
    _Base = Any
else:
    _Base = object


#: The migratable node of this process, by the number of its instance.
_NODES: Final[dict[int, Any]] = {}


class Migratable(_Base):  # type: ignore[misc]  # rclpy brings no types
    """Makes a node migratable; stands before rclpy's node, or a subclass of it, among the bases.

    Started by hand, by a launch file or by anything but rosrm, nothing is different from rclpy's
    node: no topic, no callback, no cost. Under rosrm

    - each callback of a timer, an input or a service is a *cycle*, and cycles never overlap;
    - after a cycle the state is saved and published, if somebody follows it;
    - started as the destination of a handoff, the node is a shadow: its inputs are kept, its timers
      rest, its services are not there and nothing that it publishes goes out, until it is active.

    `async` callbacks are refused under rosrm: a state lies between two callbacks.
    """

    _rosrm: Handoff | None = None

    def __init__(self, *arguments: Any, **named: Any) -> None:
        identity = identity_from(os.environ)
        if identity is not None:
            self._be_the_only_one(identity)
            self._rosrm = Handoff(self, super(), identity)
        profile = announcing(os.environ, "steady", udp=False)
        with contextlib.nullcontext() if identity is None else profile:
            super().__init__(*arguments, **named)
        if self._rosrm is not None:
            self._rosrm.begin()

    def _be_the_only_one(self, identity: Identity) -> None:
        """An instance has one state, so one node of its process can have it.

        Raises:
            RuntimeError: another node of this process is migratable already.
        """
        other = _NODES.get(identity.instance)
        _NODES[identity.instance] = self
        if other is not None and other.context.ok():
            raise RuntimeError(
                f"rosrm moves a process by one node, and {other.get_name()!r} is it already: make "
                f"the others of this process rclpy's nodes, or run each in a process of its own"
            )

    # --- for authors -----------------------------------------------------------------------

    def keep_state(
        self,
        topic: str,
        message_type: Any,
        save: Callable[[], Any],
        restore: Callable[[Any], None],
    ) -> None:
        """Name one topic of this node's state; several make a state of several parts.

        Args:
            topic: on which the state is published after each cycle, to whoever listens.
            message_type: of the topic.
            save: returns the state as a message, or None: it is what it was the last time.
            restore: takes the message, and overwrites what the node had. It is called for every
                state that a shadow receives.

        Raises:
            ValueError: the topic was named before.
        """
        if self._rosrm is not None:
            self._rosrm.keep_state(topic, message_type, save, restore)

    def when_active(self, create: Callable[[], Any]) -> None:
        """Have something made when this node becomes active: at once, unless it is a shadow.

        For what must exist in the active node only, such as an action server. What `create` returns
        is destroyed (`.destroy()`) when the node falls silent, and made anew if it goes on.
        """
        if self._rosrm is not None:
            self._rosrm.member.when_active(create)
        else:
            create()

    # --- rclpy's methods -------------------------------------------------------------------

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **named: Any) -> Any:
        """As rclpy's; what a shadow or a silent node publishes is dropped."""
        if self._rosrm is None:
            return super().create_publisher(msg_type, topic, qos_profile, **named)
        return self._rosrm.member.create_publisher(msg_type, topic, qos_profile, **named)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], qos_profile: Any, *,
        buffer: bool = True, **named: Any,
    ) -> Any:  # fmt: skip
        """As rclpy's.

        Args:
            msg_type, topic, callback, qos_profile, named: as rclpy has them.
            buffer: in a handoff every message is processed once, by the source or by the
                destination; False: what comes while the node is not active is passed over.
        """
        if self._rosrm is None:
            return super().create_subscription(msg_type, topic, callback, qos_profile, **named)
        return self._rosrm.member.create_subscription(
            msg_type, topic, callback, qos_profile, buffer=buffer, **named
        )

    def create_timer(
        self, timer_period_sec: float, callback: Callable[..., Any], *rest: Any,
        autostart: bool = True, **named: Any,
    ) -> Any:  # fmt: skip
        """As rclpy's; it rests in a shadow, and goes on in step with the source's."""
        if self._rosrm is None:
            return super().create_timer(
                timer_period_sec, callback, *rest, autostart=autostart, **named
            )
        return self._rosrm.member.create_timer(
            timer_period_sec, callback, *rest, autostart=autostart, **named
        )

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **named: Any
    ) -> Any:
        """As rclpy's; the server is there while this node is active."""
        if self._rosrm is None:
            return super().create_service(srv_type, srv_name, callback, **named)
        return self._rosrm.member.create_service(srv_type, srv_name, callback, **named)

    def create_client(self, srv_type: Any, srv_name: str, **named: Any) -> Any:
        """As rclpy's; a name below `~` is the one that others know."""
        if self._rosrm is not None:
            srv_name = self._rosrm.member.visible(srv_name, self.resolve_service_name)
        return super().create_client(srv_type, srv_name, **named)

    def destroy_service(self, service: Any) -> bool:
        """As rclpy's."""
        if isinstance(service, ServiceOf):
            self._forget(service)
            service.close()
            return True
        return bool(super().destroy_service(service))

    def destroy_publisher(self, publisher: Any) -> bool:
        """As rclpy's."""
        self._forget(publisher)
        return bool(super().destroy_publisher(publisher))

    def destroy_subscription(self, subscription: Any) -> bool:
        """As rclpy's."""
        self._forget(subscription)
        return bool(super().destroy_subscription(subscription))

    def destroy_timer(self, timer: Any) -> bool:
        """As rclpy's."""
        self._forget(timer)
        return bool(super().destroy_timer(timer))

    def destroy_node(self) -> None:
        """As rclpy's."""
        if self._rosrm is not None:
            self._rosrm.close()
            _NODES.pop(self._rosrm.identity.instance, None)
        super().destroy_node()

    def _forget(self, entity: Any) -> None:
        if self._rosrm is not None:
            self._rosrm.member.destroyed(entity)


class Node(Migratable, rclpy.node.Node):  # type: ignore[misc]  # rclpy brings no types
    """rclpy's `Node`, migratable: see `Migratable`."""
