"""The parts of a transfer: what an offer says, the archive, what may be written, and where."""

from __future__ import annotations

import fcntl
import io
import os
import stat
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.errors import TransferError
from rosrm_criu.transfer import Offer, starting
from rosrm_criu.transfer.addresses import nearest_first, own_addresses
from rosrm_criu.transfer.archive import Archive, Unpacker
from rosrm_criu.transfer.form import DIGEST_SIZE, new_digest
from rosrm_criu.transfer.landing import StagingDirectory
from rosrm_criu.transfer.sending import RateLimiter

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

OFFER = Offer(
    ("10.0.0.2", "127.0.0.1"), 4711, "ab" * 32, "secret-token", 10, 2, 2560, 30.0, to="cd" * 32
)

# --- offers -----------------------------------------------------------------------------------


def test_an_offer_survives_its_way_as_json():
    assert Offer.from_json(OFFER.as_json()) == OFFER


def test_the_representation_of_an_offer_has_no_token():
    """A logged offer does not allow a fetch."""
    assert "secret" not in repr(OFFER)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"version": 1}, "version 1 of the transfer, this host 2"),
        ({"version": None}, "version None"),
        ({"port": 0}, "values"),
        ({"port": "4711"}, "values"),
        ({"size": -1}, "values"),
        ({"length": 1 << 70}, "values"),
        ({"addresses": []}, "values"),
        ({"addresses": ["host.example"]}, "values"),
        ({"addresses": 7}, "fields"),
        ({"fingerprint": "AB"}, "values"),
        ({"token": ""}, "values"),
        ({"seconds": "long"}, "values"),
        ({"digest": "md5"}, "values"),
        ({"to": "AB"}, "values"),
        ({"to": ""}, "values"),
        ({"to": None}, "values"),
        ({"more": 1}, "fields"),
    ],
)
def test_what_is_no_offer_is_refused_with_its_reason(change, why):
    with pytest.raises(TransferError, match=why):
        Offer.from_json({**OFFER.as_json(), **change})


# --- the archive ------------------------------------------------------------------------------


def tree(directory: Path) -> Path:
    (directory / "pages" / "empty").mkdir(parents=True)
    (directory / "core.img").write_bytes(os.urandom(1000))
    (directory / "pages" / "1").write_bytes(bytes(600_000))
    (directory / "pages" / "none").write_bytes(b"")
    (directory / "pages" / ("long" * 50)).write_bytes(b"1")
    (directory / "ünicode").write_bytes(b"2" * 512)
    (directory / os.fsdecode(b"no \xff unicode")).write_bytes(b"3")
    return directory


def content(directory: Path) -> dict[str, bytes | None]:
    return {
        str(path.relative_to(directory)): None if path.is_dir() else path.read_bytes()
        for path in directory.rglob("*")
    }


class Chunks:
    """Source of the bytes of a stream, some per call."""

    def __init__(self, data: bytes) -> None:
        self._file = io.BytesIO(data)

    def __call__(self) -> bytes:
        data = self._file.read(1000)
        if not data:
            raise TransferError("the stream ended too soon")
        return data


def test_what_is_packed_is_unpacked(tmp_path):
    """Names and contents, empty files and directories too; for the owner alone."""
    archive = Archive(tree(tmp_path / "from"))
    data = b"".join(archive.pieces())
    assert len(data) == archive.length + DIGEST_SIZE
    digest = new_digest()
    digest.update(data[: archive.length])
    assert data[archive.length :] == digest.digest()

    (tmp_path / "to").mkdir()
    unpacker = Unpacker(Chunks(b"".join(archive.compressed())), archive.length)
    files = unpacker.unpack(tmp_path / "to")

    assert unpacker.check() == digest.hexdigest()

    assert files == archive.files == 6
    assert archive.size == 1000 + 600_000 + 1 + 512 + 1
    assert content(tmp_path / "to") == content(tmp_path / "from")
    for path in (tmp_path / "to").rglob("*"):
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600)


def test_a_directory_with_something_else_than_files_is_not_offered(tmp_path):
    (tmp_path / "link").symlink_to("/etc/passwd")
    with pytest.raises(TransferError, match="link is neither a file nor a directory"):
        Archive(tmp_path)


def test_a_directory_that_is_not_there_is_not_offered(tmp_path):
    with pytest.raises(TransferError, match="none is gone, or was never there"):
        Archive(tmp_path / "none")


@pytest.mark.parametrize("data", [b"longer than it was", b"", b"a link"])
def test_a_file_that_changed_since_it_was_offered_is_not_sent(tmp_path, data):
    """Neither is what stands in its place."""
    file = tmp_path / "file"
    file.write_bytes(b"as it was")
    archive = Archive(tmp_path)
    file.write_bytes(data)
    if data == b"a link":
        file.unlink()
        file.symlink_to("/etc/passwd")
    with pytest.raises(TransferError, match=r"file (has changed|cannot be read)"):
        list(archive.pieces())


# --- what may be written ----------------------------------------------------------------------


def packed(*entries: tuple[str, bytes, str], content: bytes = b"12345") -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=tarfile.PAX_FORMAT) as tar:
        for name, kind, link in entries:
            entry = tarfile.TarInfo(name)
            entry.type, entry.linkname = kind, link
            entry.size = len(content) if kind == tarfile.REGTYPE else 0
            entry.mode = 0o6777
            tar.addfile(entry, io.BytesIO(content))
    return out.getvalue()


def unpack(archive: bytes, directory: Path) -> None:
    """Unpack an archive as if it came from a source."""
    Unpacker(Chunks(zstd.compress(archive)), len(archive)).unpack(directory)


REGULAR, FOLDER = tarfile.REGTYPE, tarfile.DIRTYPE


@pytest.mark.parametrize(
    ("entries", "why"),
    [
        ([("../out", REGULAR, "")], "lies outside of it: refused"),
        ([("in/../../out", REGULAR, "")], "lies outside of it: refused"),
        ([("/out", REGULAR, "")], "lies outside of it: refused"),
        ([("out/..", FOLDER, "")], "lies outside of it: refused"),
        ([("link", tarfile.SYMTYPE, "/etc")], "neither a file nor a directory: refused"),
        ([("link", tarfile.SYMTYPE, "here")], "neither a file nor a directory: refused"),
        ([("link", tarfile.LNKTYPE, "/etc/passwd")], "neither a file nor a directory: refused"),
        ([("null", tarfile.CHRTYPE, "")], "neither a file nor a directory: refused"),
        ([("disk", tarfile.BLKTYPE, "")], "neither a file nor a directory: refused"),
        ([("pipe", tarfile.FIFOTYPE, "")], "neither a file nor a directory: refused"),
        ([("one", REGULAR, ""), ("one", REGULAR, "")], "'one' twice or out of order"),
        ([("one", FOLDER, ""), ("one", REGULAR, "")], "'one' twice or out of order"),
        ([("no/folder", REGULAR, "")], "'no/folder' twice or out of order"),
    ],
)
def test_a_hostile_archive_is_refused(tmp_path, entries, why):
    """Nothing of it comes to lie outside, and nothing but files and directories inside."""
    inside = tmp_path / "inside"
    inside.mkdir()
    with pytest.raises(TransferError, match=why):
        unpack(packed(*entries), inside)
    assert list(tmp_path.iterdir()) == [inside]
    assert all(path.is_dir() or path.is_file() for path in inside.iterdir())
    assert not any(path.is_symlink() for path in inside.iterdir())


def test_a_file_of_more_than_its_archive_is_refused(tmp_path):
    """One with holes could be of any size."""
    entry = tarfile.TarInfo("sparse")
    entry.pax_headers = {
        "GNU.sparse.major": "0", "GNU.sparse.minor": "1", "GNU.sparse.map": "0,1",
        "GNU.sparse.size": "1000000000000", "GNU.sparse.name": "sparse",
    }  # fmt: skip
    entry.size = 1
    data = entry.tobuf(tarfile.PAX_FORMAT) + b"1" + bytes(511 + 1024)
    with pytest.raises(TransferError, match="neither a file nor a directory"):
        unpack(data, tmp_path)


def test_modes_of_an_archive_count_for_nothing(tmp_path):
    unpack(packed(("folder", FOLDER, ""), ("folder/file", REGULAR, "")), tmp_path)
    assert stat.S_IMODE((tmp_path / "folder").stat().st_mode) == 0o700
    assert stat.S_IMODE((tmp_path / "folder" / "file").stat().st_mode) == 0o600


@pytest.mark.parametrize("end", [0, 100, 512, 514])
def test_an_archive_that_is_cut_is_refused(tmp_path, end):
    data = packed(("file", REGULAR, ""))[:end]
    with pytest.raises(TransferError, match=r"no sound archive|ends within 'file'"):
        unpack(data, tmp_path)


def test_what_is_no_archive_is_refused(tmp_path):
    with pytest.raises(TransferError, match="no sound archive"):
        unpack(b"no archive" * 1000, tmp_path)


# --- where it is put together -----------------------------------------------------------------


def test_a_target_appears_at_once_and_nothing_else_stays(tmp_path):
    landing = StagingDirectory(tmp_path / "new" / "target")
    (landing.path / "file").write_bytes(b"1")
    assert not (tmp_path / "new" / "target").exists()
    assert stat.S_IMODE(landing.path.stat().st_mode) == 0o700
    landing.become_target()
    landing.close()
    assert content(tmp_path / "new") == {"target": None, "target/file": b"1"}


def test_without_an_end_nothing_stays(tmp_path):
    landing = StagingDirectory(tmp_path / "target")
    (landing.path / "file").write_bytes(b"1")
    landing.close()
    assert list(tmp_path.iterdir()) == []


def test_the_directory_of_a_killed_fetch_is_removed_and_a_used_one_is_kept(tmp_path):
    """A lock marks a directory in use; files of other names stay."""
    stale = Path(tempfile.mkdtemp(prefix=".rosrm-fetch-", dir=tmp_path))
    (stale / "file").write_bytes(b"1")
    (tmp_path / "other").mkdir()
    alive = StagingDirectory(tmp_path / "first")
    assert not stale.exists()

    other = StagingDirectory(tmp_path / "second")

    assert alive.path.exists()
    alive.close()
    other.close()
    assert [path.name for path in tmp_path.iterdir()] == ["other"]


def test_the_lock_of_a_fetch_is_held_while_it_lives(tmp_path):
    landing = StagingDirectory(tmp_path / "target")
    seen = os.open(landing.path, os.O_RDONLY)
    with pytest.raises(BlockingIOError):
        fcntl.flock(seen, fcntl.LOCK_EX | fcntl.LOCK_NB)
    landing.close()
    fcntl.flock(seen, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.close(seen)


def test_nothing_is_fetched_over_what_exists(tmp_path):
    (tmp_path / "target").symlink_to("nowhere")
    with pytest.raises(TransferError, match="target exists already"):
        StagingDirectory(tmp_path / "target")


def test_a_target_in_no_directory_is_refused(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(TransferError, match=r"nothing can be made in .*file"):
        StagingDirectory(tmp_path / "file" / "target")


def test_what_has_no_room_is_refused_before_it_is_fetched(tmp_path):
    landing = StagingDirectory(tmp_path / "target")
    landing.require(1000, 1000)
    with pytest.raises(TransferError, match=r"do not fit .*are to stay free, and the file system"):
        landing.require(1 << 60, 0)
    with pytest.raises(TransferError, match=rf"{1 << 60} are to stay free"):
        landing.require(0, 1 << 60)
    landing.close()


# --- pace, addresses, libraries ---------------------------------------------------------------


@given(st.lists(st.tuples(st.integers(1, 100_000), st.floats(0, 0.2)), min_size=1, max_size=50))
def test_no_more_goes_out_than_the_rate(pieces):
    """Over any time from the start, but for what may be caught up."""
    pace, now, sent = RateLimiter(1_000_000), 100.0, 0
    for size, rest in pieces:
        now += rest
        now += pace.wait(size, now)
        sent += size
        assert sent <= 1_000_000 * (now - 100.0 + 0.05 + 1e-6)


def test_without_a_rate_nothing_waits():
    assert RateLimiter(0).wait(1 << 40, 1.0) == 0.0


def test_loopback_is_the_last_address():
    addresses = own_addresses()
    assert "127.0.0.1" in addresses
    assert addresses == tuple(sorted(addresses, key=lambda one: one.startswith("127.")))


def test_an_address_in_a_network_of_this_host_is_tried_first():
    mine = next((one for one in own_addresses() if not one.startswith("127.")), None)
    told = ["127.0.0.1", "198.51.100.7", *([mine] if mine else [])]
    assert nearest_first(told) == [*([mine] if mine else []), "198.51.100.7", "127.0.0.1"]


def test_what_is_not_installed_is_said_with_what_to_do(monkeypatch):
    monkeypatch.setattr(starting, "_NEEDED", ("cryptography", "no_such_library"))
    assert starting.missing() == "no_such_library is not installed: pip install rosrm-criu"
    with pytest.raises(TransferError, match="no_such_library is not installed"):
        starting.Sender()


def test_who_starts_a_transfer_loads_nothing_of_its_libraries():
    """They are heavy, and a slave runs on every robot."""
    code = "import sys, rosrm_criu.transfer; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.split(".")[0] for name in run.stdout.split()}
    assert not loaded & {"backports", "compression", "cryptography", "ssl"}


def test_a_python_that_cannot_check_archives_is_refused(monkeypatch):
    monkeypatch.delattr(tarfile, "data_filter")
    assert "needs 3.10.12" in starting.missing()


def test_a_transfer_killed_within_its_answer_is_reported():
    """Half a line is no answer."""
    end = starting._End.__new__(starting._End)
    end._process = subprocess.Popen(["printf", '{"error": "the'], stdout=subprocess.PIPE)
    with end._process, pytest.raises(TransferError, match="no answer"):
        end._answer(5.0)
