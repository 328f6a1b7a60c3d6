"""State directories and their files: owner, mode and links."""

from __future__ import annotations

import grp
import logging
import os
import pwd
import stat
from pathlib import Path

import pytest

from rosrm.errors import ConfigError
from rosrm.runtime import durable, private_files
from rosrm.runtime.private_files import (
    make_private_directory,
    make_private_file,
    make_safe_directory,
    open_private,
)
from rosrm.runtime.state_lock import only_one

OTHER_USER = 12345
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs files of another user")


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture
def umask():
    before = os.umask(0)
    yield
    os.umask(before)


def test_all_missing_directories_are_made_for_the_owner_alone(tmp_path, umask):
    assert make_private_directory(tmp_path / "a/b/c") == 0
    assert {mode_of(tmp_path / part) for part in ("a", "a/b", "a/b/c")} == {0o700}


def test_the_directory_of_an_earlier_release_is_tightened(tmp_path):
    state = tmp_path / "state"
    state.mkdir()
    state.chmod(0o755)
    assert make_private_directory(state) == 0o755
    assert mode_of(state) == 0o700
    assert make_private_directory(state) == 0


def test_a_tightened_state_directory_is_logged_once(tmp_path, caplog):
    """An operator who shared the directory on purpose learns why others cannot read it."""
    state = tmp_path / "state"
    state.mkdir()
    state.chmod(0o750)
    for _ in range(2):
        with caplog.at_level(logging.WARNING), only_one(state, "slave", code="", remedy=""):
            assert mode_of(state / "slave.lock") == 0o600
    assert [record.getMessage() for record in caplog.records] == [
        f"the state directory {state} had mode 0750, open to other users; it has 0700 now"
    ]


def test_a_state_directory_that_is_a_link_is_refused(tmp_path):
    """Its target would be tightened and filled with files."""
    (tmp_path / "target").mkdir()
    (tmp_path / "state").symlink_to("target")
    with pytest.raises(OSError, match=f"symbolic link; name its target, {tmp_path}/target"):
        make_private_directory(tmp_path / "state")
    assert not list((tmp_path / "target").iterdir())


def test_a_directory_that_all_users_share_is_not_tightened(tmp_path, monkeypatch):
    """`state: /tmp` of root would close /tmp for everybody."""
    tmp_path.chmod(0o1777)
    monkeypatch.setattr(private_files, "_SHARED", {str(tmp_path)})
    with pytest.raises(OSError, match="all users share it; name a directory below it"):
        make_private_directory(tmp_path)
    assert mode_of(tmp_path) == 0o1777


def test_a_link_of_the_user_on_the_way_is_followed(tmp_path):
    """A home directory may be a link."""
    (tmp_path / "disk").mkdir()
    (tmp_path / "home").symlink_to("disk")
    make_private_directory(tmp_path / "home/state")
    assert mode_of(tmp_path / "disk/state") == 0o700


def test_a_loop_of_links_is_an_error(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(OSError, match="levels of symbolic links"):
        make_private_directory(tmp_path / "a/state")


def test_a_directory_below_one_that_all_may_write_is_refused(tmp_path):
    """Any user could put another directory in its place; the sticky bit, as in /tmp, forbids it."""
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    with pytest.raises(OSError, match=f"{shared} is writable for all users.*chmod o-w"):
        make_private_directory(shared / "state")
    shared.chmod(0o1777)
    make_private_directory(shared / "state")


@as_root
def test_a_directory_below_one_that_a_group_may_write_is_refused(tmp_path):
    """Another member of the group could replace it, as in a project folder with mode 2775."""
    shared = tmp_path / "shared"
    shared.mkdir()
    os.chown(shared, 0, 12_345)
    shared.chmod(0o2775)
    with pytest.raises(OSError, match=f"{shared} is writable for the group 12345.*chmod g-w"):
        make_private_directory(shared / "state")
    shared.chmod(0o3775)
    make_private_directory(shared / "state")


def test_the_group_of_one_user_is_no_other_user(tmp_path):
    """Debian gives each user a group of its own, and an umask of 002 may go with it."""
    own = pwd.getpwuid(os.geteuid())
    group = grp.getgrgid(own.pw_gid)
    if group.gr_name != own.pw_name or {*group.gr_mem} - {own.pw_name}:
        pytest.skip("this user has no group of its own")
    (tmp_path / "project").mkdir()
    os.chown(tmp_path / "project", -1, own.pw_gid)
    (tmp_path / "project").chmod(0o775)
    make_private_directory(tmp_path / "project" / "state")


@pytest.mark.parametrize("flags", [os.O_RDONLY, os.O_RDWR | os.O_CREAT, os.O_WRONLY | os.O_CREAT])
def test_a_fifo_in_place_of_a_file_is_refused_at_once(tmp_path, flags):
    """Opening it would wait for its other end."""
    os.mkfifo(tmp_path / "file")
    with pytest.raises(OSError, match="it is no regular file"):
        open_private(str(tmp_path / "file"), flags)
    os.mkfifo(tmp_path / "made.new")
    with pytest.raises(OSError, match="it is no regular file"):
        durable.replace_atomically(str(tmp_path / "made"), b"x")


@as_root
def test_the_directory_of_another_user_is_refused(tmp_path):
    state = tmp_path / "state"
    state.mkdir(0o700)
    os.chown(state, OTHER_USER, -1)
    said = f"belongs to user {OTHER_USER}, and this is user 0; give"
    with pytest.raises(ConfigError, match=said), only_one(state, "master", code="", remedy=""):
        pytest.fail("it was used")
    assert not list(state.iterdir())


@as_root
@pytest.mark.parametrize("link", [False, True])
def test_a_directory_below_that_of_another_user_is_refused(tmp_path, link):
    """Such a directory can be replaced at any time, and such a link leads anywhere."""
    above, target = tmp_path / "above", tmp_path / "target"
    target.mkdir()
    above.symlink_to(target) if link else above.mkdir()
    os.chown(above, OTHER_USER, -1, follow_symlinks=False)
    with pytest.raises(
        OSError, match=f"{above} belongs to user {OTHER_USER}, who could replace it"
    ):
        make_private_directory(above / "state")
    assert not (target / "state").exists()


@pytest.mark.parametrize("name", ["master", "slave"])
def test_a_lock_that_is_a_link_is_neither_followed_nor_truncated(tmp_path, name):
    """As root this emptied any file of the system."""
    victim, state = tmp_path / "victim", tmp_path / "state"
    victim.write_text("precious")
    state.mkdir(0o700)
    (state / f"{name}.lock").symlink_to(victim)
    said = "it is a symbolic link; give this"
    with pytest.raises(ConfigError, match=said), only_one(state, name, code="", remedy=""):
        pytest.fail("it was used")
    assert victim.read_text() == "precious"


def test_an_opened_file_is_for_its_owner_alone(tmp_path, umask):
    """A file of an earlier release is tightened."""
    (tmp_path / "old").touch(0o644)
    for name in ("old", "new"):
        os.close(open_private(str(tmp_path / name), os.O_WRONLY | os.O_CREAT))
        assert mode_of(tmp_path / name) == 0o600


def test_a_file_is_tightened_without_opening_it(tmp_path):
    """Closing a second descriptor of a database would release its locks."""
    old = tmp_path / "old"
    old.touch(0o644)
    make_private_file(str(old))
    make_private_file(str(tmp_path / "missing"))
    assert mode_of(old) == 0o600


def test_only_regular_files_of_this_user_are_opened(tmp_path):
    (tmp_path / "link").symlink_to("target")
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "directory").mkdir()
    for name in ("link", "fifo", "directory"):
        with pytest.raises(OSError, match=r"link|regular|directory"):
            open_private(str(tmp_path / name), os.O_RDWR | os.O_CREAT)
        with pytest.raises(OSError, match=r"link|regular|directory"):
            make_private_file(str(tmp_path / name))
    assert not (tmp_path / "target").exists()


@as_root
def test_a_file_of_another_user_is_refused(tmp_path):
    """Its owner could open it before, and read everything that is written to it."""
    planted = tmp_path / "planted"
    planted.touch()
    os.chown(planted, OTHER_USER, -1)
    with pytest.raises(OSError, match=f"belongs to user {OTHER_USER}"):
        open_private(str(planted), os.O_RDWR)


def test_a_directory_for_recordings_may_be_shared(tmp_path):
    """Recordings are new files of mode 0600; the directory may be the home of a user."""
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o755)
    make_safe_directory(shared)
    assert mode_of(shared) == 0o755


def test_processes_of_users_keep_the_umask_of_the_user(monkeypatch, umask):
    """Only files of rosrm are private; the programs that it starts decide about theirs."""
    monkeypatch.setattr(private_files, "_user_umask", -1)
    assert private_files.user_umask() == -1
    private_files.set_private_umask()
    assert private_files.user_umask() == 0
    assert os.umask(0) == 0o077
