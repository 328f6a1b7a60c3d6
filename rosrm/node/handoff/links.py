"""Links of a node with its master, and with the parties of a handoff.

The session imports this module when the first message for its node arrives, because the module
loads PyNaCl (0.8 MiB), and most nodes are never moved.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rosrm.keys.derivation import KEY_BYTES
from rosrm.keys.handoffs import new_link
from rosrm.keys.names import handoff_name, instance_name
from rosrm.keys.sealing import Direction
from rosrm.node.identity import NodeIdentity
from rosrm.ros.names import Names
from rosrm.ros.sealed_topic import SealedTopic
from rosrm_msgs.msg import HandoffReport, StateConfig


class NodeLinks:
    """Links of one instance.

    Attributes:
        configs: topic of the master's messages about handoffs.
        questions: topic of the reports of a silent source to the master.
    """

    def __init__(self, identity: NodeIdentity) -> None:
        link = new_link(identity.key, Direction.TO_MASTER, Direction.FROM_MASTER)
        name = instance_name(identity.process, identity.instance)
        names = Names(identity.namespace)
        self._has_key = identity.key is not None
        self.configs = SealedTopic(link, name, StateConfig, identity.state_config)
        self.questions = SealedTopic(link, name, HandoffReport, names.stranded_sources)

    def of_handoff(self, config: StateConfig) -> Callable[[Any, str], SealedTopic]:
        """Return a function that returns a topic of a handoff, from message type and name.

        Raises:
            ValueError: the master has sent no key, although this node has one.
        """
        key = bytes(config.key) if self._has_key else None
        if key is not None and len(key) != KEY_BYTES:
            raise ValueError(f"the key of the handoff has {len(key)} bytes, not {KEY_BYTES}")
        link = new_link(key, Direction.TO_PEER, Direction.TO_PEER)
        return partial(SealedTopic, link, handoff_name(config.process, config.destination))
