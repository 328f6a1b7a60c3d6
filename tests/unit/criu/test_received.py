"""Images from another host: their files, their paths and the users of their processes."""

from __future__ import annotations

import os
import struct
from dataclasses import replace
from pathlib import Path

import pytest

from rosrm.errors import CriuError
from rosrm_criu.engine import image, received
from rosrm_criu.engine.image import HeldFile, MappedFile
from tests.unit.criu.test_image import MANIFEST
from tests.unit.criu.test_relocation import field

#: An ordinary user: this one, or any where the tests run as root.
USER, GROUP = os.getuid() or 1000, 1000
as_root = pytest.mark.skipif(os.getuid() != 0, reason="only root has files that root takes")
#: creds_entry: the four ids of the user, and the four of the group.
IDS = {**dict.fromkeys((1, 3, 5, 7), USER), **dict.fromkeys((2, 4, 6, 8), GROUP)}


def credentials(*more: bytes, **changed: int) -> bytes:
    """Return a creds_entry; `changed` has ids by "f" and their number."""
    ids = {**IDS, **{int(name[1:]): value for name, value in changed.items()}}
    return b"".join(field(number, value) for number, value in ids.items()) + b"".join(more)


def core(*entries: bytes) -> bytes:
    """Return CRIU's file of a thread with some creds_entries."""
    thread = field(1, 7) + field(2, 24) + b"".join(field(10, entry) for entry in entries)
    message = field(1, 1) + field(3, field(6, b"brain")) + field(5, thread)
    return b"magicnum" + struct.pack("<I", len(message)) + message


@pytest.fixture(autouse=True)
def slave(monkeypatch):
    """Let this process be the slave of an ordinary user; return a function that makes it root."""
    monkeypatch.setattr(os, "getegid", lambda: GROUP)
    monkeypatch.setattr(os, "getgroups", lambda: [GROUP, 27])
    monkeypatch.setattr(received, "_own_capabilities", lambda: 0)

    def runs_as(uid: int) -> None:
        monkeypatch.setattr(os, "geteuid", lambda: uid)

    return runs_as


@pytest.fixture
def arrived(tmp_path, slave):
    """Return a function that checks an image with some changes as one that has just arrived."""
    state, work = tmp_path / "slave", tmp_path / "slave/work"
    work.mkdir(parents=True)

    def check(
        content: dict[str, bytes] | None = None,
        *,
        named: str | None = None,
        uid: int = USER,
        slave_user: int = USER,
        more: dict[str, bytes] | None = None,
        **changed: object,
    ) -> None:
        directory = tmp_path / "image"
        image.create(directory)
        (directory / "files").mkdir(mode=0o700)
        honest = {"criu/core-1.img": core(credentials()), "files/0": b"1"}
        for name, data in {**honest, **(content or {})}.items():
            (directory / name).write_bytes(data)
        told = replace(
            MANIFEST, working_directory="/theirs/work", shelter="/theirs/work", mapped=(),
            files=(HeldFile("/theirs/work/count", 1, 0o644, False, "files/0"),),
        )  # fmt: skip
        made = {"sizes": image.file_sizes(directory), "checksums": {}, **changed}
        image.write(directory, replace(told, **made))
        for name, data in (more or {}).items():
            (directory / name).write_bytes(data)
        slave(slave_user)
        received.check(directory, state=state, working_directory=named, uid=uid)

    return check


def test_an_honest_image_passes(arrived):
    """The default working directory of the source becomes that of this host."""
    arrived()


def test_dump_log_is_part_of_an_image(arrived):
    arrived(more={"dump.log": b"(00.01) done"})


@pytest.mark.parametrize("name", ["hold.json", "of", "criu/core-2.img", "files/1", "restored.pid"])
def test_a_file_that_the_manifest_does_not_name_is_refused(arrived, name):
    """A result of a restore, for example, would tell the shim that the image was used up."""
    with pytest.raises(CriuError, match=f"holds '{name}', which its manifest does not name"):
        arrived(more={name: core(credentials())})


# --- paths ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path", ["/etc/cron.d/x", "/theirs/work/../x", "/theirs/working", "x", "/theirs/work"]
)
def test_a_copy_lies_below_the_working_directory(arrived, path):
    with pytest.raises(CriuError, match="does not lie below"):
        arrived(files=(HeldFile(path, 1, 0o644, False, "files/0"),))


def test_the_image_does_not_choose_the_working_directory(arrived):
    """Else a source would name the directory that it wants to write to."""
    with pytest.raises(CriuError, match=r"works in /etc, which is not below .*slave/work"):
        arrived(
            working_directory="/etc", files=(HeldFile("/etc/passwd", 1, 0o644, False, "files/0"),)
        )


@pytest.mark.parametrize("place", ["{named}", "{named}/below", "{real}/below"])
def test_a_named_working_directory_may_be_a_link_and_the_process_may_work_below_it(
    arrived, tmp_path, place
):
    real, named = tmp_path / "real", tmp_path / "named"
    real.mkdir()
    named.symlink_to(real)
    work = place.format(named=named, real=real)
    held = HeldFile(f"{work}/count", 1, 0o644, False, "files/0")
    arrived(named=str(named), working_directory=work, files=(held,))


def test_a_process_that_works_elsewhere_moves_if_no_file_follows_it(arrived):
    arrived(working_directory="/", files=(HeldFile("/lib/x", 1, 0o644, False, ""),))


@pytest.mark.parametrize("path", ["log", "/log/../x", ""])
def test_an_append_only_file_has_a_plain_path(arrived, path):
    with pytest.raises(CriuError, match="does not lie below /"):
        arrived(files=(HeldFile(path, 1, 0o644, True, ""),))


def test_a_path_that_begins_like_one_of_lttng_is_refused(arrived):
    with pytest.raises(CriuError, match="is none of LTTng"):
        arrived(mapped=(MappedFile("/dev/shm/lttng-ust-wait-8/../../etc/x", 1, 0o644),))


# --- users ------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", sorted(IDS))
def test_a_foreign_id_is_refused(arrived, number):
    """Each of the eight ids counts, and so does root's."""
    with pytest.raises(CriuError, match=r"would run (as the user|with the group) 0"):
        arrived({"criu/core-1.img": core(credentials(**{f"f{number}": 0}))})


@pytest.mark.parametrize(
    "entries",
    [
        [credentials(), credentials(f1=0)],
        [credentials(f1=0), credentials()],
        [credentials(field(1, 0))],
        [credentials(f1=(1 << 32))],
    ],
    ids=["second entry", "first entry", "second value", "high bits"],
)
def test_each_value_counts_whichever_criu_reads(arrived, entries):
    with pytest.raises(CriuError, match="would run as the user 0"):
        arrived({"criu/core-1.img": core(*entries)})


def test_each_thread_counts(arrived):
    with pytest.raises(CriuError, match="would run as the user 0"):
        arrived({"criu/core-2.img": core(credentials(f3=0))})


@pytest.mark.parametrize("groups", [[field(14, 0)], [field(14, b"\x1b\x00")]])
def test_a_further_group_must_be_one_of_the_slave(arrived, groups):
    """Packed numbers count like single ones."""
    with pytest.raises(CriuError, match="with the group 0"):
        arrived({"criu/core-1.img": core(credentials(*groups))})


def test_a_group_of_the_slave_is_allowed(arrived):
    arrived({"criu/core-1.img": core(credentials(field(14, 27), field(14, GROUP)))})


@pytest.mark.parametrize("number", [10, 11])
def test_capabilities_of_the_slave_alone_are_allowed(arrived, monkeypatch, number):
    """The numbers are the words of one set, the lowest first."""
    image_of = {"criu/core-1.img": core(credentials(field(number, 0), field(number, 1 << 8)))}
    with pytest.raises(CriuError, match="with capabilities that this host's slave"):
        arrived(image_of)


def test_capabilities_that_the_slave_has_are_allowed(arrived, monkeypatch):
    monkeypatch.setattr(received, "_own_capabilities", lambda: 1 << 40 | 1 << 3)
    arrived({"criu/core-1.img": core(credentials(field(10, 1 << 3), field(10, 1 << 8)))})


@pytest.mark.parametrize(
    "content",
    [b"", b"magicnum", core(), core(credentials())[:-1], b"magicnum\xff\xff\xff\xff", bytes(9)],
    ids=["empty", "no message", "no credentials", "cut", "too long", "noise"],
)  # fmt: skip
def test_an_image_that_does_not_show_its_user_is_refused(arrived, content):
    with pytest.raises(CriuError, match=r"does not show the user|is damaged: criu/core-1\.img"):
        arrived({"criu/core-1.img": content})


@pytest.mark.parametrize("name", ["criu/creds-1.img", "criu/userns-13.img"])
def test_other_sources_of_credentials_are_refused(arrived, name):
    """CRIU would take the user from them, or translate it."""
    with pytest.raises(CriuError, match="does not show the user"):
        arrived({name: core(credentials())})


@as_root
def test_as_root_the_user_that_the_source_reported_is_restored(arrived):
    """The slave was allowed to take images as root: the image's user is root or that one."""
    arrived({"criu/core-1.img": core(credentials(f2=5))}, slave_user=0, uid=USER)


@as_root
def test_as_root_another_user_than_the_reported_one_is_refused(arrived):
    with pytest.raises(CriuError, match=f"would run as the user {USER}"):
        arrived(slave_user=0, uid=33)


def test_a_process_of_another_user_is_not_fetched_at_all(slave):
    slave(USER)
    with pytest.raises(CriuError, match="belongs to the user 0, and this host's slave runs as"):
        received.check_source(0)
    received.check_source(USER)
    slave(0)
    received.check_source(USER)


def test_a_link_in_place_of_the_image_is_refused(tmp_path, slave):
    slave(os.getuid())
    (tmp_path / "real").mkdir(mode=0o700)
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with pytest.raises(CriuError, match="is a link, or belongs to another user"):
        received.check(Path(tmp_path / "link"), state=tmp_path, working_directory=None, uid=USER)
