"""Files that a restore writes: below the working directory, through no link, with plain modes."""

from __future__ import annotations

import os
import stat
from dataclasses import replace
from pathlib import Path

import pytest

from rosrm.errors import CriuError
from rosrm_criu.engine import image
from rosrm_criu.engine.image import HeldFile, MappedFile
from rosrm_criu.engine.put_back import is_tracing, prepare
from tests.unit.criu.test_image import MANIFEST


@pytest.fixture
def directory(tmp_path):
    """Return an image with one copy of a file."""
    made = tmp_path / "image"
    image.create(made)
    (made / "files").mkdir(mode=0o700)
    (made / "files/0").write_bytes(b"content")
    return made


def put(directory: Path, work: Path, *files: HeldFile, mapped: tuple[MappedFile, ...] = ()) -> None:
    """Put files back as if the manifest of an image named them."""
    told = replace(MANIFEST, working_directory=str(work), files=files, mapped=mapped)
    prepare(directory, replace(told, checksums={}))


def copied(path: object, mode: int = 0o640) -> HeldFile:
    return HeldFile(str(path), 7, mode, False, "files/0")


def test_a_file_is_put_back_with_its_folders_and_replaces_another(work, directory):
    put(directory, work, copied(work / "a/b/c"))
    assert (work / "a/b/c").read_bytes() == b"content"
    assert stat.S_IMODE((work / "a/b/c").stat().st_mode) == 0o640
    (work / "a/b/c").write_bytes(b"another")
    put(directory, work, copied(work / "a/b/c", 0o600))
    assert (work / "a/b/c").read_bytes() == b"content"
    assert [path.name for path in (work / "a/b").iterdir()] == ["c"]


@pytest.mark.parametrize("mode", [0o4755, 0o2755, 0o1777, 0o7777, 1 << 40 | 0o755])
def test_no_file_gets_the_rights_of_its_owner_or_group(work, directory, mode):
    """As root it would be a program that runs as root for everyone."""
    put(directory, work, copied(work / "tool", mode))
    assert stat.S_IMODE((work / "tool").stat().st_mode) == mode & 0o777
    grown = HeldFile(str(work / "grown"), 0, mode, True, "")
    put(directory, work, grown)
    assert stat.S_IMODE((work / "grown").stat().st_mode) & 0o7000 == 0


@pytest.mark.parametrize(
    "path",
    ["/etc/passwd", "{work}", "{work}/", "{work}/../out", "{work}/a/../../out", "{work}/./a",
     "{work}/a//b", "{work}ing/out", "out", "", "{work}/a\0b"],
)  # fmt: skip
def test_nothing_is_written_outside_of_the_working_directory(work, directory, tmp_path, path):
    with pytest.raises(CriuError, match="does not lie below"):
        put(directory, work, copied(path.format(work=work)))
    assert sorted(one.name for one in tmp_path.iterdir()) == ["image", "work"]
    assert list(work.iterdir()) == []


def test_of_a_process_in_the_root_directory_nothing_is_expected_and_detours_are_refused(directory):
    with pytest.raises(CriuError, match="does not lie below"):
        put(directory, Path("/"), copied("/tmp/../etc/rosrm-test"))


def test_a_link_on_the_way_is_not_followed(work, directory, tmp_path):
    """Otherwise a user who may write there would choose the files that the slave overwrites."""
    (tmp_path / "away").mkdir()
    (work / "link").symlink_to(tmp_path / "away")
    with pytest.raises(CriuError, match="is a symbolic link, which is not followed"):
        put(directory, work, copied(work / "link/file"))
    with pytest.raises(CriuError, match="is a symbolic link, which is not followed"):
        put(directory, work, HeldFile(str(work / "link/log"), 0, 0o600, True, ""))
    assert list((tmp_path / "away").iterdir()) == []


def test_a_link_in_place_of_the_file_is_replaced_and_its_target_left_alone(
    work, directory, tmp_path
):
    (tmp_path / "secret").write_bytes(b"secret")
    (work / "file").symlink_to(tmp_path / "secret")
    (work / ".file.rosrm").symlink_to(tmp_path / "secret")
    put(directory, work, copied(work / "file"))
    assert (tmp_path / "secret").read_bytes() == b"secret"
    assert not (work / "file").is_symlink()
    assert (work / "file").read_bytes() == b"content"


def test_the_working_directory_itself_may_be_a_link(work, directory, tmp_path):
    """The process's file chooses it, not the image."""
    (tmp_path / "data").symlink_to(work)
    put(directory, tmp_path / "data", copied(tmp_path / "data/file"))
    assert (work / "file").read_bytes() == b"content"


def test_an_append_only_file_is_created_only_where_it_is_missing(work, directory, tmp_path):
    log = tmp_path / "log/ros/one.log"
    put(directory, work, HeldFile(str(log), 100, 0o644, True, ""))
    assert log.read_bytes() == b""
    log.write_bytes(b"line")
    put(directory, work, HeldFile(str(log), 100, 0o644, True, ""))
    assert log.read_bytes() == b"line"


def test_a_file_of_lttng_is_told_by_its_whole_name():
    assert is_tracing("/dev/shm/lttng-ust-wait-8-1000")
    for name in ("/../../etc/cron.d/x", "8/../../etc/x", "", "8\n", "8/x"):
        assert not is_tracing(f"/dev/shm/lttng-ust-wait-{name}")


@pytest.mark.parametrize("size", [-1, 1 << 40])
def test_a_file_of_lttng_is_small(work, directory, size):
    path = f"/dev/shm/lttng-ust-wait-{os.getpid()}-none"
    with pytest.raises(CriuError, match="is no file of LTTng"):
        put(directory, work, mapped=(MappedFile(path, size, 0o4777),))
    assert not Path(path).exists()


def test_a_file_of_lttng_gets_a_plain_mode(work, directory):
    path = Path(f"/dev/shm/lttng-ust-wait-{os.getpid()}-test")
    try:
        put(directory, work, mapped=(MappedFile(str(path), 4096, 0o4640),))
        assert stat.S_IMODE(path.stat().st_mode) == 0o640
    finally:
        path.unlink(missing_ok=True)
