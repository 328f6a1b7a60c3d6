"""Which instance of which process this is: rosrm's slave says it in the environment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import Final

#: Seconds by which a kept state may be behind, where nothing is said.
KEEP_EVERY: Final = 1.0


@dataclass(frozen=True, slots=True)
class Identity:
    """Who a node is to rosrm.

    Attributes:
        process: name of the process.
        instance: its number.
        node: fully qualified name under which others know it, whatever its alias; "": its own.
        state_config: topic on which the master speaks.
        cluster: name of the master that had it started.
        epoch: of that master.
        shadow: it starts as the destination of a handoff.
        keep: directory in which its state is kept; "": it is not.
        keep_every: seconds by which what is kept may be behind.
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


def identity_from(environment: Mapping[str, str]) -> Identity | None:
    """The identity that a slave gave; None: this process was not started by rosrm."""
    process, _, number = environment.get("ROSRM_INSTANCE", "").rpartition("#")
    topic = environment.get("ROSRM_STATE_CONFIG", "")
    if not process or not number.isdecimal() or not topic:
        return None
    epoch = environment.get("ROSRM_EPOCH", "")
    return Identity(
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
