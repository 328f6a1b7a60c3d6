"""Identity of this process's instance, from the environment that rosrm's slave sets."""

from __future__ import annotations

import base64
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Final

#: Default bound in seconds on the age of a snapshot.
KEEP_EVERY: Final = 1.0
#: Bytes of the key of an instance.
_KEY_BYTES: Final = 32
#: Variable with the file that has it, and most bytes of that file.
_KEY_FILE: Final = "ROSRM_INSTANCE_KEY_FILE"
_LONGEST_KEY: Final = 64
#: Most digits of an epoch.
_EPOCH_DIGITS: Final = 20


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
        epoch_file: where the slave writes the newest epoch of the master; "": nowhere.
        key: of the instance, shared with the master; None: with `security: none`.
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
    epoch_file: str = ""
    key: bytes | None = field(default=None, repr=False)

    @property
    def namespace(self) -> str:
        """Namespace of rosrm's topics."""
        return self.state_config.rpartition("/")[0]

    def registered_epoch(self) -> int | None:
        """Return the newest epoch of the master that the slave knows; None: not known."""
        try:
            with Path(self.epoch_file).open("rb") as file:
                return int(file.read(_EPOCH_DIGITS))
        except (OSError, ValueError):
            return None


#: Environment of the process whose node is being made; None: this process.
_ENVIRONMENT: Final = ContextVar[Mapping[str, str] | None]("environment", default=None)


@contextmanager
def made_for(environment: Mapping[str, str]) -> Iterator[None]:
    """Let nodes that are made now belong to the process with this environment; {}: to none."""
    token = _ENVIRONMENT.set(environment)
    try:
        yield
    finally:
        _ENVIRONMENT.reset(token)


def own_identity() -> NodeIdentity | None:
    """Return the identity of a node that is being made; raises `ValueError` as `identity_from`."""
    environment = _ENVIRONMENT.get()
    return identity_from(os.environ if environment is None else environment)


def identity_from(environment: Mapping[str, str]) -> NodeIdentity | None:
    """Return the identity set by a slave; None if rosrm did not start this process.

    Raises:
        ValueError: the key of the instance is damaged. Without a key the node would accept all
            messages.
    """
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
        epoch_file=environment.get("ROSRM_EPOCH_FILE", ""),
        key=_key(environment),
    )


def _key(environment: Mapping[str, str]) -> bytes | None:
    """Return the key of the instance; None: with `security: none`."""
    text, path = environment.get("ROSRM_INSTANCE_KEY", ""), environment.get(_KEY_FILE, "")
    if not text and path:
        try:
            with Path(path).open("rb") as file:
                text = file.read(_LONGEST_KEY).decode("ascii")
        except (OSError, ValueError) as error:
            raise ValueError(f"{_KEY_FILE}={path} cannot be read: {error}") from None
    elif not text:
        return None
    try:
        key = base64.b64decode(text, validate=True)
    except ValueError:
        key = b""
    if len(key) != _KEY_BYTES:
        raise ValueError(f"the key of the instance must have {_KEY_BYTES} bytes in base64")
    return key


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        return KEEP_EVERY
    return seconds if 0.0 <= seconds < inf else KEEP_EVERY
