"""Roles and the requests that each may send."""

from __future__ import annotations

import pytest

from rosrm.errors import ConfigError
from rosrm.keys.roles import ALLOWED, Principal, Role, may_act_on, may_send, principal_of

ADA = Principal("user", "ada")


def test_what_is_not_in_the_table_is_refused() -> None:
    """No role may send a request that the table lacks."""
    assert not any(may_send(role, "format_disk") for role in Role)


def test_a_host_sends_no_request_of_users_and_a_user_none_of_hosts() -> None:
    """A stolen robot cannot submit, and an operator cannot register as a host."""
    of_hosts = {request for request, roles in ALLOWED.items() if Role.HOST in roles}
    of_users = {request for request, roles in ALLOWED.items() if roles - {Role.HOST}}
    assert of_hosts & of_users == {"handshake"}


@pytest.mark.parametrize(
    ("role", "owner", "may"),
    [
        (Role.OPERATOR, "user:bob", True),
        (Role.OPERATOR, "", True),
        (Role.SUBMITTER, "user:ada", True),
        (Role.SUBMITTER, "user:bob", False),
        (Role.SUBMITTER, "host:ada", False),
        (Role.SUBMITTER, "", False),
        (Role.VIEWER, "user:ada", False),
        (Role.HOST, "user:ada", False),
    ],
)
def test_a_submitter_acts_on_its_own_processes_alone(role: Role, owner: str, *, may: bool) -> None:
    """An operator acts on all of them, another role on none."""
    assert may_act_on(role, ADA, owner) is may


@pytest.mark.parametrize("text", ["host:robot-1", "user:ada@desk", "host:" + "x" * 128])
def test_a_principal_is_read_as_it_is_written(text: str) -> None:
    """Host or user, and a name."""
    assert str(principal_of(text)) == text


@pytest.mark.parametrize(
    "text", ["", "robot-1", "host:", "admin:x", "host:a b", "host:\x1b[2J", "user:" + "x" * 129]
)
def test_other_principals_are_refused(text: str) -> None:
    """The message says what is allowed."""
    with pytest.raises(ConfigError, match="write host:NAME or user:NAME"):
        principal_of(text)
