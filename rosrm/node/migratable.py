"""`Node`: rclpy's node, for processes that rosrm can move with their state."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final
from weakref import WeakValueDictionary

import rclpy.node

from rosrm.node.entities import ServiceOf
from rosrm.node.handoff.session import HandoffSession
from rosrm.node.identity import NodeIdentity, own_identity
from rosrm.ros.fast_dds import announcing
from rosrm.ros.peer_announcements import request_announcements

if TYPE_CHECKING:
    _Base = Any
else:
    _Base = object


#: The migratable node of each process whose nodes run here, by the number of its instance.
_NODES: Final = WeakValueDictionary[int, Any]()


class Migratable(_Base):  # type: ignore[misc]  # rclpy brings no types
    """Base class of a migratable node, listed before rclpy's `Node` or a subclass of that.

    Without rosrm (started by hand or by a launch file) the node equals rclpy's: no topic, no
    callback, no cost. Under rosrm

    - each callback of a timer, an input or a service is a *cycle*, and cycles never overlap;
    - after a cycle the state is saved and published, if it has a successor;
    - a node started as the destination of a handoff is a shadow until it is active: inputs are
      buffered, timers stopped, services absent, and published messages dropped.

    rosrm refuses `async` callbacks, because a state lies between two callbacks.
    """

    _rosrm: HandoffSession | None = None

    def __init__(self, *arguments: Any, **named: Any) -> None:
        identity = own_identity()
        if identity is not None:
            self._be_the_only_one(identity)
            self._rosrm = HandoffSession(self, super(), identity)
        profile = announcing(os.environ, "steady", udp=False)
        with contextlib.nullcontext() if identity is None else profile:
            super().__init__(*arguments, **named)
        if self._rosrm is not None:
            request_announcements(self.context.get_domain_id(), os.environ)
            self._rosrm.begin()

    def _be_the_only_one(self, identity: NodeIdentity) -> None:
        """Register the migratable node of this process; a process has at most one.

        Raises:
            RuntimeError: another node of this process is migratable already.
        """
        other = _NODES.get(identity.instance)
        if other is not None and other.context.ok():
            raise RuntimeError(
                f"rosrm moves a process by one node, and {other.get_name()!r} is it already: make "
                f"the others of this process rclpy's nodes, or run each in a process of its own"
            )
        _NODES[identity.instance] = self

    # --- for authors -----------------------------------------------------------------------

    def keep_state(
        self, topic: str, message_type: Any, save: Callable[[], Any],
        restore: Callable[[Any], None],
    ) -> None:  # fmt: skip
        """Name one topic of this node's state; several calls make a state of several parts.

        Args:
            topic: the state is published on it during a handoff; only the successor can read it.
            message_type: message class of the topic.
            save: returns the state as a message, or None: unchanged since the last time.
            restore: takes the message, and overwrites the node's state. A shadow calls it for every
                state that it receives.

        Raises:
            ValueError: the topic was named before.
        """
        if self._rosrm is not None:
            self._rosrm.keep_state(topic, message_type, save, restore)

    def when_active(self, create: Callable[[], Any]) -> None:
        """Call `create` when this node becomes active: at once, unless it is a shadow.

        This is for objects that may exist in the active node only, such as an action server. The
        node destroys the result (`.destroy()`) when it falls silent, and creates it again if it
        resumes.
        """
        if self._rosrm is not None:
            self._rosrm.entities.when_active(create)
        else:
            create()

    # --- rclpy's methods -------------------------------------------------------------------

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **named: Any) -> Any:
        """Create a publisher as rclpy does; messages of a shadow or a silent node are dropped."""
        if self._rosrm is None:
            return super().create_publisher(msg_type, topic, qos_profile, **named)
        return self._rosrm.entities.create_publisher(msg_type, topic, qos_profile, **named)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], qos_profile: Any, *,
        buffer: bool = True, **named: Any,
    ) -> Any:  # fmt: skip
        """Create a subscription as rclpy does.

        Args:
            buffer: in a handoff every message is processed once, by the source or by the
                destination; False: messages are skipped while the node is not active.
        """
        if self._rosrm is None:
            return super().create_subscription(msg_type, topic, callback, qos_profile, **named)
        return self._rosrm.entities.create_subscription(
            msg_type, topic, callback, qos_profile, buffer=buffer, **named
        )

    def create_timer(
        self, timer_period_sec: float, callback: Callable[..., Any], *rest: Any,
        autostart: bool = True, **named: Any,
    ) -> Any:  # fmt: skip
        """Create a timer as rclpy does; in a shadow it starts later, in phase with the source's."""
        if self._rosrm is None:
            return super().create_timer(
                timer_period_sec, callback, *rest, autostart=autostart, **named
            )
        return self._rosrm.entities.create_timer(
            timer_period_sec, callback, *rest, autostart=autostart, **named
        )

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **named: Any
    ) -> Any:
        """Create a service as rclpy does; the server exists while this node is active."""
        if self._rosrm is None:
            return super().create_service(srv_type, srv_name, callback, **named)
        return self._rosrm.entities.create_service(srv_type, srv_name, callback, **named)

    def create_client(self, srv_type: Any, srv_name: str, **named: Any) -> Any:
        """Create a client as rclpy does; a name below `~` uses the node name that peers know."""
        if self._rosrm is not None:
            srv_name = self._rosrm.entities.visible(srv_name, self.resolve_service_name)
        return super().create_client(srv_type, srv_name, **named)

    def destroy_service(self, service: Any) -> bool:
        """Destroy a service as rclpy does."""
        if isinstance(service, ServiceOf):
            self._forget(service)
            service.close()
            return True
        return bool(super().destroy_service(service))

    def destroy_publisher(self, publisher: Any) -> bool:
        """Destroy a publisher as rclpy does."""
        self._forget(publisher)
        return bool(super().destroy_publisher(publisher))

    def destroy_subscription(self, subscription: Any) -> bool:
        """Destroy a subscription as rclpy does."""
        self._forget(subscription)
        return bool(super().destroy_subscription(subscription))

    def destroy_timer(self, timer: Any) -> bool:
        """Destroy a timer as rclpy does."""
        self._forget(timer)
        return bool(super().destroy_timer(timer))

    def destroy_node(self) -> None:
        """Destroy the node as rclpy does; a last snapshot is stored first."""
        if self._rosrm is not None:
            self._rosrm.close()
            _NODES.pop(self._rosrm.identity.instance, None)
        super().destroy_node()

    def _forget(self, entity: Any) -> None:
        if self._rosrm is not None:
            self._rosrm.entities.destroyed(entity)


def restore_now(node: Any) -> None:
    """Restore the snapshot of a node whose constructor has returned, if it has one.

    Raises:
        StateError: the node must be destroyed. In an executor, the error would end all its nodes.
    """
    session = node._rosrm if isinstance(node, Migratable) else None  # noqa: SLF001 - a node of ours
    if session is not None:
        session.restore_now()


class Node(Migratable, rclpy.node.Node):  # type: ignore[misc]  # rclpy brings no types
    """rclpy's `Node`, migratable: see `Migratable`."""
