"""Principals, their roles, and the requests that each role may send; all others are denied."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

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


class Permission(NamedTuple):
    """The roles that may send a request.

    Attributes:
        action: the effect of the request, for a refusal: "submit processes".
    """

    roles: frozenset[Role]
    action: str


#: The permission of each request, by the name of its service. All other requests are refused.
ALLOWED: Final[Mapping[str, Permission]] = {
    "handshake": Permission(_READERS | _HOSTS, "connect to the master"),
    "introduce": Permission(_SUBMITTERS | _HOSTS, "read logs"),
    "list": Permission(_READERS, "list hosts and processes"),
    "explain": Permission(_READERS, "ask for explanations"),
    "submit": Permission(_SUBMITTERS, "submit processes"),
    "apply": Permission(_SUBMITTERS, "change applications"),
    "load_modes": Permission(_OPERATORS, "load modes"),
    "switch_mode": Permission(_OPERATORS, "switch the mode"),
    "cancel": Permission(_SUBMITTERS, "cancel processes"),
    "restart": Permission(_SUBMITTERS, "restart processes"),
    "migrate": Permission(_SUBMITTERS, "migrate processes"),
    "checkpoint": Permission(_SUBMITTERS, "checkpoint processes"),
    "restore": Permission(_SUBMITTERS, "restore processes"),
    "kill": Permission(_OPERATORS, "kill processes"),
    "prune": Permission(_OPERATORS, "remove hosts and processes from the listing"),
    "rebalance": Permission(_OPERATORS, "rebalance the hosts"),
    "reload": Permission(_OPERATORS, "reload the settings"),
    "set_host_state": Permission(_OPERATORS, "cordon, uncordon or drain hosts"),
    "register_host": Permission(_HOSTS, "register a host"),
    "leave": Permission(_HOSTS, "end the registration of a host"),
    "request_process": Permission(_HOSTS, "request work for a host"),
    "store_artifact": Permission(_SUBMITTERS, "send artifacts"),
    "read_artifact": Permission(_HOSTS, "read artifacts"),
    # Services of slaves:
    "control": Permission(_MASTERS, "control a slave"),
    "read_log": Permission(_BEARERS, "read logs"),
    "store_replica": Permission(_BEARERS, "store replicas of snapshots"),
    "read_snapshot": Permission(_BEARERS, "read snapshots"),
}


def may_send(role: Role, request: str) -> bool:
    """Return True if a role may send a request, given by the name of its service."""
    return request in ALLOWED and role in ALLOWED[request].roles


def action_of(request: str) -> str:
    """Return the effect of a request as a verb with its object."""
    return ALLOWED[request].action if request in ALLOWED else f"send {request!r}"
