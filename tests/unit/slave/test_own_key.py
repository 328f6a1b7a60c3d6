"""A slave without a key waits for one, and logs the remedy."""

from __future__ import annotations

import logging
import threading

from rosrm.config.settings import HostConfig
from rosrm.keys import key_files
from rosrm.keys.roles import Grant, Principal, Role
from rosrm.slave import own_key
from rosrm.slave.own_key import security_without_key, wait_for_security


def test_a_slave_starts_as_soon_as_its_host_has_a_key(tmp_path, monkeypatch, caplog) -> None:
    """As when slaves start before the first master of this user."""
    caplog.set_level(logging.INFO)
    monkeypatch.setenv("ROSRM_KEYS", str(tmp_path))
    monkeypatch.setattr(own_key, "_LOOK", 0.01)
    found: list = []
    waiting = threading.Thread(
        target=lambda: found.append(wait_for_security(HostConfig(host="robot-1"))), daemon=True
    )
    waiting.start()
    secret = key_files.make_secret(tmp_path)
    waiting.join(20.0)
    assert found[0].master.name == "host:robot-1"
    grant = Grant(Principal("host", "robot-1"), Role.HOST, 0)
    assert found[0].instance_key("p", 1) == own_key.MemberSecurity(
        secret.key_of(grant)
    ).instance_key("p", 1)
    assert all("rosrm key add host:robot-1" in line for line in caplog.messages)


def test_with_security_none_no_key_is_needed(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("ROSRM_KEYS", str(tmp_path))
    assert wait_for_security(HostConfig(host="a", security="none")).described == "none"


def test_a_slave_that_only_stops_processes_needs_no_key() -> None:
    """A random key, which is another one each time."""
    one, other = security_without_key("a"), security_without_key("a")
    assert one.instance_key("p", 1) != other.instance_key("p", 1)
