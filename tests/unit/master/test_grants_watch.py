"""Watch of the key files: changes apply without a restart of the master."""

from __future__ import annotations

import logging

import pytest

from rosrm.keys import key_files
from rosrm.keys.roles import Principal, Role
from rosrm.keys.security import MasterSecurity
from rosrm.master.grants_watch import GrantsWatch

ROBOT = Principal("host", "robot-1")


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("ROSRM_KEYS", str(tmp_path))
    return tmp_path


@pytest.fixture
def security(home) -> MasterSecurity:
    return MasterSecurity(key_files.make_secret(home))


def test_added_and_revoked_keys_are_found_within_a_second(home, security) -> None:
    """Unchanged files are not read again."""
    watch = GrantsWatch(security)
    assert watch.has_changed(0.0)
    assert not watch.has_changed(1.0)
    grant = key_files.add_grant(home, ROBOT, Role.HOST)
    assert watch.has_changed(2.0)
    robot = security.peer("host:robot-1", grant.generation)
    assert robot is not None
    key_files.revoke(home, [ROBOT])
    assert watch.has_changed(3.0)
    assert not security.has_access(robot)


def test_files_that_cannot_be_used_change_nothing_and_are_reported_once(
    home, security, caplog
) -> None:
    """The operator's mistake must not lock all hosts out."""
    caplog.set_level(logging.ERROR)
    grant = key_files.add_grant(home, ROBOT, Role.HOST)
    watch = GrantsWatch(security)
    assert watch.has_changed(0.0)
    (home / key_files.GRANTS_FILE).write_text("principals: 7")
    (home / key_files.GRANTS_FILE).chmod(0o644)
    for now in (1.0, 2.0, 3.0):
        assert not watch.has_changed(now)
    assert security.peer("host:robot-1", grant.generation) is not None
    (line,) = caplog.messages
    assert "chmod 600" in line


def test_a_file_counts_as_soon_as_it_can_be_read(home, security) -> None:
    """A changed mode changes no time of the file; a lack of descriptors passes, too."""
    grant = key_files.add_grant(home, ROBOT, Role.HOST)
    watch = GrantsWatch(security)
    assert watch.has_changed(0.0)
    key_files.revoke(home, [ROBOT])
    (home / key_files.GRANTS_FILE).chmod(0o644)
    assert not watch.has_changed(1.0)
    (home / key_files.GRANTS_FILE).chmod(0o600)
    assert watch.has_changed(3.0)
    assert security.peer("host:robot-1", grant.generation) is None
