"""Roles and the requests that each may send."""

from __future__ import annotations

import pytest

from rosrm.errors import ConfigError
from rosrm.keys.roles import ALLOWED, Role, action_of, may_send, principal_of


def test_requests_that_the_table_lacks_are_refused() -> None:
    """No role may send them."""
    assert not any(may_send(role, "format_disk") for role in Role)


def test_a_host_sends_no_request_of_users_and_a_user_none_of_hosts() -> None:
    """A stolen robot cannot submit, and an operator cannot register as a host."""
    of_hosts = {request for request, one in ALLOWED.items() if Role.HOST in one.roles}
    of_users = {request for request, one in ALLOWED.items() if one.roles - {Role.HOST}}
    assert of_hosts & of_users == {"handshake", "introduce"}


def test_each_request_has_words_for_a_refusal() -> None:
    """Names of services are internal; only a request that the table lacks is named by its own."""
    assert action_of("introduce") == "read logs"
    assert not any("_" in action_of(request) for request in ALLOWED)
    assert action_of("format_disk") == "send 'format_disk'"


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
