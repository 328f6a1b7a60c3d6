"""Roles and the requests that each may send."""

from __future__ import annotations

import pytest

from rosrm.errors import ConfigError
from rosrm.keys.roles import ALLOWED, Role, may_send, principal_of


def test_requests_that_the_table_lacks_are_refused() -> None:
    """No role may send them."""
    assert not any(may_send(role, "format_disk") for role in Role)


def test_a_host_sends_no_request_of_users_and_a_user_none_of_hosts() -> None:
    """A stolen robot cannot submit, and an operator cannot register as a host."""
    of_hosts = {request for request, roles in ALLOWED.items() if Role.HOST in roles}
    of_users = {request for request, roles in ALLOWED.items() if roles - {Role.HOST}}
    assert of_hosts & of_users == {"handshake", "introduce"}


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
