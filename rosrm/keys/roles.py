"""Principals, their roles, and the requests that each role may send; all others are denied."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final, Literal

from rosrm.errors import ConfigError

if TYPE_CHECKING:
    from typing_extensions import Self

_NAME: Final = re.compile(r"[A-Za-z0-9_.~/@-]{1,128}")

#: Setting `security` of a cluster.
SecurityMode = Literal["keys", "none"]


def default_security() -> SecurityMode:
    """Return the default of `security`: ROSRM_SECURITY, or else "keys".

    Raises:
        ConfigError: the variable has a value that is not allowed.
    """
    modes: Mapping[str, SecurityMode] = {"keys": "keys", "none": "none"}
    text = os.environ.get("ROSRM_SECURITY") or "keys"
    if text not in modes:
        raise ConfigError(f"ROSRM_SECURITY={text!r}; allowed: {', '.join(modes)}")
    return modes[text]


class Role(str, Enum):
    """Rights of a principal.

    Attributes:
        meaning: one line for users.
    """

    meaning: str

    def __new__(cls, text: str, meaning: str = "") -> Self:
        """Create a role from its name in a key file and its meaning."""
        role = str.__new__(cls, text)
        role._value_ = text
        role.meaning = meaning
        return role

    VIEWER = "viewer", "reads listings, explanations and events"
    SUBMITTER = "submitter", "as `viewer`; submits processes, and changes those that it submitted"
    OPERATOR = "operator", "sends every request that users can send, for all processes and hosts"
    HOST = "host", "registers and reports the host of its name, and no other"
    MASTER = "master", "sends orders to hosts; the role of the master alone, in no key file"
    BEARER = "bearer", "sends requests of the kind that its ticket allows; in no key file"


@dataclass(frozen=True, slots=True)
class Principal:
    """Holder of a key: a host or a user."""

    kind: Literal["host", "user"]
    name: str

    def __str__(self) -> str:
        """Return "host:robot-1" or "user:ada"."""
        return f"{self.kind}:{self.name}"


def principal_of(text: str) -> Principal:
    """Return the principal that a text names, "host:robot-1" or "user:ada".

    Raises:
        ConfigError: the text names no principal.
    """
    kind, _, name = text.partition(":")
    if kind == "host" and _NAME.fullmatch(name):
        return Principal("host", name)
    if kind == "user" and _NAME.fullmatch(name):
        return Principal("user", name)
    raise ConfigError(
        f"{text!r} names no principal; write host:NAME or user:NAME, with a name of 1 to 128 "
        f"letters, digits and characters of _ . ~ / @ -"
    )


@dataclass(frozen=True, slots=True)
class Grant:
    """The role of a principal.

    Attributes:
        generation: number that distinguishes the keys of the principal, from 1; 0 for a key that
            needs no entry in `principals.yaml`, because its holder can read the cluster's secret.
    """

    principal: Principal
    role: Role
    generation: int


_READERS: Final = frozenset({Role.VIEWER, Role.SUBMITTER, Role.OPERATOR})
_SUBMITTERS: Final = frozenset({Role.SUBMITTER, Role.OPERATOR})
_OPERATORS: Final = frozenset({Role.OPERATOR})
_HOSTS: Final = frozenset({Role.HOST})
_MASTERS: Final = frozenset({Role.MASTER})
_BEARERS: Final = frozenset({Role.BEARER})

#: Roles that key files can have.
GRANTED: Final = (Role.VIEWER, Role.SUBMITTER, Role.OPERATOR, Role.HOST)

#: The roles that may send a request, by the name of its service. All other roles are refused.
ALLOWED: Final[Mapping[str, frozenset[Role]]] = {
    "handshake": _READERS | _HOSTS,
    "introduce": _SUBMITTERS | _HOSTS,
    "list": _READERS,
    "explain": _READERS,
    "submit": _SUBMITTERS,
    "apply": _SUBMITTERS,
    "load_modes": _OPERATORS,
    "switch_mode": _OPERATORS,
    "cancel": _SUBMITTERS,
    "restart": _SUBMITTERS,
    "migrate": _SUBMITTERS,
    "checkpoint": _SUBMITTERS,
    "restore": _SUBMITTERS,
    "kill": _OPERATORS,
    "prune": _OPERATORS,
    "rebalance": _OPERATORS,
    "reload": _OPERATORS,
    "set_host_state": _OPERATORS,
    "register_host": _HOSTS,
    "leave": _HOSTS,
    "request_process": _HOSTS,
    "store_artifact": _SUBMITTERS,
    "read_artifact": _HOSTS,
    # Services of slaves:
    "control": _MASTERS,
    "read_log": _BEARERS,
    "store_replica": _BEARERS,
    "read_snapshot": _BEARERS,
}


def may_send(role: Role, request: str) -> bool:
    """Return True if a role may send a request, given by the name of its service."""
    return role in ALLOWED.get(request, frozenset())
