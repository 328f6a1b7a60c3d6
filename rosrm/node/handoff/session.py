"""Handoff role of a migratable node, and its subscription to the master's messages."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from rosrm import clocks
from rosrm.errors import describe_fault
from rosrm.keys.names import instance_name
from rosrm.node.handoff.destination import Destination
from rosrm.node.handoff.source import HandoffSource
from rosrm.node.handoff.state_parts import ParametersPart, StateTopic
from rosrm.node.identity import NodeIdentity
from rosrm.node.managed_node import NodeEntities
from rosrm.node.snapshots.restore import SnapshotRestore, newest_snapshot
from rosrm.node.steady_timer import steady_timer
from rosrm.ros.qos import STATE_CONFIG
from rosrm.ros.sealed_codec import decode
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import Sealed, StateConfig

if TYPE_CHECKING:
    from rosrm.node.handoff.links import NodeLinks

_MARK: Final = "_rosrm/mark"
_PARAMETERS: Final = "_rosrm/parameters"
#: Most reasons for refusals that are logged, each once, and the most letters of a name in one.
_MOST_REASONS: Final = 16
_LONGEST_NAME: Final = 64
#: Epochs by which one message may be ahead, where the slave does not say which is the newest.
_EPOCH_STEP: Final = 1000
#: Most messages of an epoch that the slave does not know yet, and the seconds for which each is
#: held. A master that was restarted may reach the node before its answer reaches the slave.
_MOST_EARLY: Final = 16
_EARLY_FOR: Final = 5.0
#: Seconds between two looks if the slave knows the epoch.
_LOOK: Final = 0.1


class HandoffSession:
    """Handoffs of one node: possibly first as a destination, later as a source.

    `plain` gives access to rclpy's own methods of the node.
    """

    def __init__(self, node: Any, plain: Any, identity: NodeIdentity) -> None:
        self._snapshot, self._damaged = newest_snapshot(identity)
        resting = identity.shadow or self._snapshot is not None
        self.entities = NodeEntities(node, plain, identity, resting=resting)
        self.identity = identity
        self._epoch = identity.epoch
        self._parts: list[StateTopic] = []
        self._source: HandoffSource | None = None
        self._destination: Destination | None = None
        self._restore: SnapshotRestore | None = None
        self._before_source: deque[StateConfig] = deque(maxlen=_MOST_EARLY)
        self._refused: set[str] = set()
        self._early: deque[tuple[StateConfig, float]] = deque(maxlen=_MOST_EARLY)
        self._early_timer: Any = None
        self._subscription: Any = None
        self._name = instance_name(identity.process, identity.instance)
        self._links: NodeLinks | None = None

    def begin(self) -> None:
        """Take the first role; called by `Node`'s constructor, before the author's continues."""
        node = self.entities.node
        for fault in self._damaged:
            node.get_logger().warning(f"ignoring a damaged snapshot: {fault}")
        self._parts.append(ParametersPart(self._own(_PARAMETERS), node))
        if self.identity.shadow:
            self._destination = Destination(
                self.entities, self._parts, self._own(_MARK), self._become_source
            )
        elif self._snapshot is not None:
            self._restore = SnapshotRestore(
                self.entities, self._parts, self._snapshot, self._become_source
            )
        else:
            self._become_source()
        self._subscription = self.entities.plain.create_subscription(
            Sealed, self.identity.state_config, self._received, STATE_CONFIG, raw=True
        )

    def _own(self, path: str) -> str:
        return f"{self.entities.visible_node}/{path}"

    def restore_now(self) -> None:
        """Restore the snapshot, if there is one, before the first round; raises `StateError`."""
        if self._restore is not None:
            self._restore.restore()

    def _become_source(self) -> None:
        self._snapshot = self._restore = None
        self._source = HandoffSource(self.entities, self._parts, self._own(_MARK))
        while self._before_source:
            self._configured(self._before_source.popleft())

    def keep_state(
        self, topic: str, message_type: Any, save: Callable[[], Any], restore: Callable[[Any], None]
    ) -> None:
        """Add a part of the state on a topic that the author names."""
        resolve = self.entities.node.resolve_topic_name
        full = resolve(self.entities.visible(topic, resolve))
        if any(part.topic == full for part in self._parts):
            raise ValueError(f"keep_state: {full} is named twice; each part has a topic of its own")
        part = StateTopic(full, message_type, save, restore)
        self._parts.append(part)
        if self._source is not None:
            self._source.add_part(part)
        elif self._destination is not None:
            self._destination.follow_part(part)

    # --- state_config ----------------------------------------------------------------------

    def _received(self, data: bytes) -> None:
        envelope = decode(data)
        if envelope is None or envelope.principal != self._name:
            return
        config = self._opened_links().configs.read(data)
        if config is None:
            self._refuse("it is not of this node's master, or it is repeated")
        else:
            self._configured(config)

    def _opened_links(self) -> NodeLinks:
        if self._links is None:
            from rosrm.node.handoff.links import NodeLinks  # noqa: PLC0415 - see there

            self._links = NodeLinks(self.identity)
        return self._links

    def _configured(self, config: StateConfig) -> None:
        own = self.identity
        if config.process != own.process or own.instance not in (config.source, config.destination):
            return
        fault = self._fault_of(config)
        if fault:
            self._refuse(fault)
            return
        if self._is_early(config):
            self._hold(config, clocks.boot_time() + _EARLY_FOR)
            return
        if self._early and config.epoch > self._epoch:
            self._look_at_early()  # earlier messages of the new master come first
        self._epoch = config.epoch
        role = self._destination if own.instance == config.destination else self._source
        if role is None:
            # A node reports ACTIVE before it is a source; the next handoff may begin in between.
            if own.instance == config.source:
                self._before_source.append(config)
            return
        with self.entities.turn:
            try:
                role.configure(config, self._opened_links())
            except Exception as error:  # noqa: BLE001 - no message of the master may end the node
                what = describe_fault(error)
                self.entities.node.get_logger().error(
                    f"a state_config cannot be followed: {what}", throttle_duration_sec=10.0
                )

    def _fault_of(self, config: StateConfig) -> str:
        """Return the reason to ignore this message; "" if it comes from this node's master."""
        if config.protocol_version != PROTOCOL_VERSION:
            return (
                f"its protocol version is {config.protocol_version}, this node's {PROTOCOL_VERSION}"
            )
        if config.cluster != self.identity.cluster:
            theirs = config.cluster[:_LONGEST_NAME]
            return f"it is of {theirs!r}, and {self.identity.cluster!r} started this node"
        # A master with an older copy of its journal counts from there, and the slave knows it.
        if config.epoch < self._epoch and config.epoch != self.identity.registered_epoch():
            return f"it is of epoch {config.epoch}, and this is epoch {self._epoch}"
        if not config.channel:
            return "it names no channel"
        if not config.channel.startswith(f"{self.identity.namespace}/handoff/"):
            return "its channel is no topic of a handoff"
        return ""

    def _is_early(self, config: StateConfig) -> bool:
        """Return True if a message has an epoch that the slave does not know.

        A forged epoch would make this node deaf to its master for ever.
        """
        if config.epoch <= self._epoch:
            return False
        registered = self.identity.registered_epoch()
        newest = self._epoch + _EPOCH_STEP if registered is None else registered
        return bool(config.epoch > newest)

    def _hold(self, config: StateConfig, until: float) -> None:
        self._early.append((config, until))
        if self._early_timer is None:
            self._early_timer = steady_timer(self.entities.plain, _LOOK, self._look_at_early)

    def _look_at_early(self) -> None:
        """Follow held messages whose epoch the slave knows now; drop old ones."""
        held = list(self._early)
        self._early.clear()
        for config, until in held:
            if not self._is_early(config):
                self._configured(config)
            elif clocks.boot_time() < until:
                self._early.append((config, until))
            else:
                self._refuse(
                    f"it is of epoch {config.epoch}, which the slave of this host does not know"
                )
        if not self._early and self._early_timer is not None:
            self.entities.plain.destroy_timer(self._early_timer)
            self._early_timer = None

    def _refuse(self, fault: str) -> None:
        if fault not in self._refused and len(self._refused) < _MOST_REASONS:
            self._refused.add(fault)
            self.entities.node.get_logger().warning(f"a state_config is left alone: {fault}")

    def close(self) -> None:
        """End all roles, because the node is destroyed."""
        for role in (self._source, self._destination):
            if role is not None:
                role.close()
        if self._source is not None:
            self._source.end()
