"""Symbolic links in control directories of another user, none of which is followed.

The slave may be root. Each test does with real files what such a user could do.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rosrm.errors import PortableError
from rosrm_criu.control import client
from rosrm_criu.control.client import ask_resume, control_directory, make_directory
from rosrm_criu.control.directory import remove_directory
from rosrm_criu.control.listener import Listener
from rosrm_criu.control.messages import Request, State, Status, Want, read_message, write_message

#: Uid of a user who owns nothing.
NOBODY = 65534


@pytest.fixture
def precious(tmp_path):
    """Return a file of this process's user, alone in its directory; no test may change it."""
    (tmp_path / "etc").mkdir()
    file = tmp_path / "etc" / "precious"
    file.write_text("ours")
    return file


@pytest.fixture
def directory(tmp_path):
    """Return a new control directory."""
    make_directory(tmp_path / "user" / "c")
    return tmp_path / "user" / "c"


@pytest.fixture
def of_nobody(tmp_path, monkeypatch):
    """Return the path of another user's control directory, which only root can create."""
    if os.geteuid() != 0:
        pytest.skip("only root can give a directory to another user")
    monkeypatch.setattr(client, "control_root", lambda uid: tmp_path / f"rosrm-{uid}" / "portable")
    return control_directory("c", NOBODY)


def unchanged(precious: Path) -> bool:
    """Return True if the file is unchanged, and still alone in its directory."""
    return (
        precious.read_text() == "ours"
        and precious.stat().st_uid == precious.parent.stat().st_uid == os.geteuid()
        and list(precious.parent.iterdir()) == [precious]
    )


@pytest.mark.parametrize("name", ["request", ".request.new", "status", ".status.new"])
def test_a_write_follows_no_link(directory, precious, name) -> None:
    """A write replaces a link, and changes neither its target nor another name of the file."""
    for make in (os.symlink, os.link):
        (directory / name).unlink(missing_ok=True)
        make(precious, directory / name)
        write_message(directory, Request("m1", Want.LEAVE))
        write_message(directory, Status(State.RUNNING))
        assert unchanged(precious)
        assert read_message(directory, Status) == Status(State.RUNNING)


def test_nothing_is_written_where_a_link_leads(directory, precious) -> None:
    """A write fails if the directory, or one above it, is a link."""
    for link in (directory, directory.parent):
        there = link.rename(link.with_name(f"{link.name}-there"))
        for leads_to in (precious.parent, there):
            link.symlink_to(leads_to)
            with pytest.raises(PortableError, match="cannot be written: Not a directory"):
                ask_resume(directory, None, "m1")
            link.unlink()
        there.rename(link)
    assert unchanged(precious)


def test_what_is_read_is_no_link(directory, precious) -> None:
    """A read through a link fails, and does not reveal whether its target exists."""
    (directory / "status").symlink_to(precious)
    with pytest.raises(PortableError, match="status cannot be read"):
        read_message(directory, Status)


def test_a_directory_is_not_made_where_a_link_leads(tmp_path, precious) -> None:
    """A link on the path of a new directory is refused by name before anything is created."""
    (tmp_path / "portable").symlink_to(precious.parent)
    with pytest.raises(PortableError, match=f"{tmp_path / 'portable'} is no directory"):
        make_directory(tmp_path / "portable" / "c")
    assert unchanged(precious)


def test_a_directory_is_removed_through_no_link(tmp_path, directory, precious) -> None:
    """A removal keeps the targets of links, in the directory, in its place, and above it."""
    (directory / "status").symlink_to(precious)
    remove_directory(directory)
    assert not directory.exists()
    directory.symlink_to(precious.parent)
    remove_directory(directory)
    (tmp_path / "above").symlink_to(tmp_path)
    remove_directory(tmp_path / "above" / "etc")
    assert unchanged(precious)


def test_a_node_makes_its_directory_as_carefully(tmp_path, precious) -> None:
    """A listener refuses a link, and a directory in which others could make its node leave."""
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    with pytest.raises(PortableError, match="open to all"):
        Listener(tmp_path / "open" / "c")
    (tmp_path / "portable").symlink_to(precious.parent)
    with pytest.raises(PortableError, match="is no directory"):
        Listener(tmp_path / "portable" / "c")
    assert unchanged(precious)


def test_another_users_directory_is_given_to_that_user(of_nobody) -> None:
    """The user owns all newly created directories, and existing ones keep their owners."""
    make_directory(of_nobody, NOBODY)
    make_directory(of_nobody, NOBODY)
    made = (of_nobody, of_nobody.parent, of_nobody.parent.parent)
    assert [one.stat().st_uid for one in made] == [NOBODY] * 3
    assert made[-1].parent.stat().st_uid == 0


def test_nothing_else_is_given_to_a_user(of_nobody, precious, monkeypatch) -> None:
    """A link that replaces a new directory at once does not give its target to the user."""
    mkdir = os.mkdir

    def mkdir_and_swap(path, *arguments, **named) -> None:
        mkdir(path, *arguments, **named)
        if os.fspath(path).endswith("c"):
            made = named.get("dir_fd")
            os.rename(path, "moved", src_dir_fd=made, dst_dir_fd=made)
            os.symlink(precious, path, dir_fd=made)

    monkeypatch.setattr(os, "mkdir", mkdir_and_swap)
    with pytest.raises(PortableError, match="is no directory"):
        make_directory(of_nobody, NOBODY)
    assert unchanged(precious)


@pytest.fixture
def roots(tmp_path, monkeypatch):
    """Use parents of control directories in the test's own folder; /run/rosrm does not exist."""
    (tmp_path / "tmp").mkdir()
    (tmp_path / "tmp").chmod(0o1777)
    names = ("service/0/portable", "tmp/rosrm-0/portable", "tmp/second/portable")
    monkeypatch.setattr(client, "control_roots", lambda uid: tuple(tmp_path / n for n in names))
    monkeypatch.setattr(client, "_SERVICE", tmp_path / "service")
    return tmp_path


def test_the_directory_of_the_service_is_preferred_where_it_exists(roots) -> None:
    """No other user can take a name there, and no cleaner of /tmp removes its files."""
    assert client.make_control_root(os.geteuid()) == roots / "tmp/rosrm-0/portable"
    assert not (roots / "service").exists()
    (roots / "service").mkdir()
    assert client.make_control_root(os.geteuid()) == roots / "service/0/portable"


def test_a_taken_name_costs_another_directory(roots, precious) -> None:
    """Any user can create /tmp/rosrm-UID first, as a directory of its own or as a link."""
    taken = roots / "tmp/rosrm-0"
    taken.symlink_to(precious.parent)
    assert client.make_control_root(os.geteuid()) == roots / "tmp/second/portable"
    if os.geteuid() == 0:
        taken.unlink()
        taken.mkdir()
        os.chown(taken, NOBODY, -1)
        assert client.make_control_root(os.geteuid()) == roots / "tmp/second/portable"
    assert unchanged(precious)


def test_where_every_name_is_taken_each_reason_is_given(roots) -> None:
    """The launcher refuses the start with it, and the master tries another host."""
    for name in ("rosrm-0", "second"):
        (roots / "tmp" / name).write_text("taken")
    with pytest.raises(PortableError, match="no control directory can be made") as refusal:
        client.make_control_root(os.geteuid())
    for name in ("rosrm-0", "second"):
        assert f"{roots}/tmp/{name} is no directory" in str(refusal.value)


def test_a_control_directory_has_a_known_parent() -> None:
    """A path of another host is accepted if that host may have chosen it."""
    for root in client.control_roots(1000):
        assert client.is_control_directory(root / "token", 1000)
        assert not client.is_control_directory(root / "token", 1001)
        assert not client.is_control_directory(root / "token/deeper", 1000)
    assert not client.is_control_directory(Path("/etc/cron.d"), 1000)


def test_a_user_gets_no_directory_elsewhere(of_nobody, precious) -> None:
    """A path outside the user's control root is refused, since a process could report any path."""
    with pytest.raises(PortableError, match=r"no control directory of user 65534"):
        make_directory(precious.parent / "cron.d", NOBODY)
    assert unchanged(precious)
