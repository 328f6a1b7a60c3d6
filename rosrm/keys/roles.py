"""Principals, their roles, and the requests that each role may send: deny by default."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final, Literal

from rosrm.errors import ConfigError

if TYPE_CHECKING:
    from typing_extensions import Self

_NAME: Final = re.compile(r"[A-Za-z0-9_.~/@-]{1,128}")


class Role(str, Enum):
    """What a principal may do.

    Attributes:
        meaning: one line for users.
    """

    meaning: str

    def __new__(cls, text: str, meaning: str = "") -> Self:
        """Make a member from its name in a key file and its meaning."""
        role = str.__new__(cls, text)
        role._value_ = text
        role.meaning = meaning
        return role

    VIEWER = "viewer", "reads listings, explanations and events"
    SUBMITTER = "submitter", "reads too, submits processes, and changes those that it submitted"
    OPERATOR = "operator", "sends every request that users can send, for all processes and hosts"
    HOST = "host", "speaks for the host of its name, and for no other"


@dataclass(frozen=True, slots=True)
class Principal:
    """Who has a key: a host or a user."""

    kind: Literal["host", "user"]
    name: str

    def __str__(self) -> str:
        """Return "host:robot-1" or "user:ada"."""
        return f"{self.kind}:{self.name}"


def principal_of(text: str) -> Principal:
    """Return the principal of a text, "host:robot-1" or "user:ada".

    Raises:
        ConfigError: the text is none.
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
        generation: number of the principal's key: a new key has the next one, 0 is the key that
            whoever holds the cluster's secret derives for itself.
    """

    principal: Principal
    role: Role
    generation: int


_READERS: Final = frozenset({Role.VIEWER, Role.SUBMITTER, Role.OPERATOR})
_SUBMITTERS: Final = frozenset({Role.SUBMITTER, Role.OPERATOR})
_OPERATORS: Final = frozenset({Role.OPERATOR})
_HOSTS: Final = frozenset({Role.HOST})

#: The roles that may send a request, by the name of its service. What is missing is refused.
ALLOWED: Final[Mapping[str, frozenset[Role]]] = {
    "handshake": frozenset(Role),
    "list": _READERS,
    "explain": _READERS,
    "submit": _SUBMITTERS,
    "cancel": _SUBMITTERS,
    "restart": _SUBMITTERS,
    "migrate": _SUBMITTERS,
    "checkpoint": _SUBMITTERS,
    "restore": _SUBMITTERS,
    "prune": _OPERATORS,
    "read_log": _SUBMITTERS,
    "set_host_state": _OPERATORS,
    "register_host": _HOSTS,
    "leave": _HOSTS,
    "request_process": _HOSTS,
}


def may_send(role: Role, request: str) -> bool:
    """Return True if a role may send a request, given by the name of its service."""
    return role in ALLOWED.get(request, frozenset())


def may_act_on(role: Role, principal: Principal, owner: str) -> bool:
    """Return True if a principal may change a process or read its logs.

    Args:
        role: of the principal.
        principal: who asks.
        owner: text of the principal that submitted the process; "": unknown.
    """
    return role is Role.OPERATOR or (role is Role.SUBMITTER and owner == str(principal))
