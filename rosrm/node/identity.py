"""Identity of this process's instance, from the environment that rosrm's slave sets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import Final

#: Default bound in seconds on the age of a snapshot.
KEEP_EVERY: Final = 1.0


@dataclass(frozen=True, slots=True)
class NodeIdentity:
    """Identity of a node within rosrm.

    Attributes:
        process: name of the process.
        instance: its number.
        node: fully qualified name that peers use, whatever its alias; "": the node's own name.
        state_config: topic of the master's messages.
        cluster: name of the master that started it.
        epoch: of that master.
        shadow: it starts as the destination of a handoff.
        keep: directory of its snapshots; "" if none are written.
        keep_every: greatest age of a snapshot, seconds.
    """

    process: str
    instance: int
    node: str
    state_config: str
    cluster: str
    epoch: int
    shadow: bool
    keep: str = ""
    keep_every: float = KEEP_EVERY


def identity_from(environment: Mapping[str, str]) -> NodeIdentity | None:
    """Return the identity set by a slave; None if rosrm did not start this process."""
    process, _, number = environment.get("ROSRM_INSTANCE", "").rpartition("#")
    topic = environment.get("ROSRM_STATE_CONFIG", "")
    if not process or not number.isdecimal() or not topic:
        return None
    epoch = environment.get("ROSRM_EPOCH", "")
    return NodeIdentity(
        process=process,
        instance=int(number),
        node=environment.get("ROSRM_NODE", ""),
        state_config=topic,
        cluster=environment.get("ROSRM_MASTER", ""),
        epoch=int(epoch) if epoch.isdecimal() else 0,
        shadow=environment.get("ROSRM_SHADOW", "") == "1",
        keep=environment.get("ROSRM_KEEP", ""),
        keep_every=_seconds(environment.get("ROSRM_KEEP_EVERY", "")),
    )


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        return KEEP_EVERY
    return seconds if 0.0 <= seconds < inf else KEEP_EVERY
