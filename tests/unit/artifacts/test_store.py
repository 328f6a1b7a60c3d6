"""The master's store of artifacts: uploads, bounds, references, restarts."""

from __future__ import annotations

from hashlib import sha256

import pytest

from rosrm.artifacts.store import ArtifactStore
from rosrm.errors import Refused
from rosrm.model.ledger import Store, bound_of
from tests.limits import no_more_files

NONE: frozenset[str] = frozenset()


class Clock:
    """A clock that only the test moves."""

    now = 5000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def store(tmp_path, clock):
    return ArtifactStore(tmp_path / "store", 10_000, clock)


def data_of(byte: int, size: int = 4000) -> tuple[str, bytes]:
    data = bytes([byte]) * size
    return sha256(data).hexdigest(), data


def put(store, data: bytes, keep=NONE, sender: str = "ada") -> str:
    """Store contents in parts of 1500 bytes; return their digest."""
    digest, size = sha256(data).hexdigest(), len(data)
    offset = store.take(sender, digest, size, 0, b"", keep=keep)
    while offset < size:
        part = data[offset : offset + 1500]
        offset = store.take(sender, digest, size, offset, part, keep=NONE)
    return digest


def files(tmp_path) -> set[str]:
    return {path.name for path in (tmp_path / "store").iterdir()}


def test_contents_are_stored_under_their_digest(store, tmp_path):
    """Each part can be read again; a part after the end is empty."""
    digest, data = data_of(1)
    assert not store.has(digest, 4000)
    assert put(store, data) == digest
    assert store.has(digest, 4000)
    assert not store.has(digest, 3999)
    assert store.read(digest, 3000, 9000) == (4000, data[3000:])
    assert store.read(digest, 5000, 10) == (4000, b"")
    assert files(tmp_path) == {digest}


def test_known_contents_are_not_sent_again(store):
    """The answer to the first question is the whole size."""
    digest, data = data_of(1)
    put(store, data)
    assert store.take("bo", digest, len(data), 0, b"", keep=NONE) == len(data)


def test_a_repeated_and_an_early_part_change_nothing(store):
    """The answer names the expected offset, whatever was sent."""
    digest, data = data_of(1)
    take = lambda offset, part: store.take("ada", digest, 4000, offset, part, keep=NONE)  # noqa: E731
    assert take(0, b"") == 0
    assert take(0, data[:1000]) == 1000
    assert take(0, data[:1000]) == 1000
    assert take(2000, data[2000:]) == 1000
    assert take(1000, data[1000:]) == 4000


def test_other_contents_than_the_digest_are_refused(store, tmp_path):
    """A file that changed while it was sent leaves nothing behind."""
    digest, _ = data_of(1)
    store.take("ada", digest, 4000, 0, b"", keep=NONE)
    with pytest.raises(Refused, match=r"changed while they were sent.*submit again") as refusal:
        store.take("ada", digest, 4000, 0, bytes(4000), keep=NONE)
    assert refusal.value.code == "changed"
    assert files(tmp_path) == set()


def test_no_sender_spoils_the_upload_of_another(store):
    """Wrong contents of one user do not mix with those of another."""
    digest, data = data_of(1)
    for sender in ("ada", "eve"):
        store.take(sender, digest, 4000, 0, b"", keep=NONE)
    store.take("ada", digest, 4000, 0, data[:2000], keep=NONE)
    with pytest.raises(Refused):
        store.take("eve", digest, 4000, 0, bytes(4000), keep=NONE)
    assert store.take("ada", digest, 4000, 2000, data[2000:], keep=NONE) == 4000


def test_no_user_takes_the_uploads_of_others(store):
    """The runs of one principal share a bound; another principal may still begin an upload."""
    most = bound_of(Store.UPLOADS, is_operator=False).number
    for number in range(most):
        store.take(f"user:eve {number}", data_of(number)[0], 10, 0, b"", keep=NONE)
    with pytest.raises(Refused, match="user:eve is sending") as refusal:
        store.take("user:eve more", data_of(99)[0], 10, 0, b"", keep=NONE)
    assert refusal.value.code == "busy"
    assert store.take("user:ada 1", data_of(99)[0], 10, 0, b"", keep=NONE) == 0


def test_the_oldest_unreferenced_contents_give_way(store, clock):
    """Contents that a process refers to stay, and those that were offered a moment ago."""
    first, second = put(store, data_of(1)[1]), put(store, data_of(2)[1])
    with pytest.raises(Refused, match=r"no room for an artifact of 4.0 kB.*artifacts.max_size"):
        put(store, data_of(3)[1])
    clock.now += 601.0
    third = put(store, data_of(3)[1], keep=frozenset({first}))
    assert store.has(first, 4000)
    assert not store.has(second, 4000)
    assert store.has(third, 4000)


def test_contents_larger_than_the_store_are_refused(store):
    """The message has both sizes and the setting."""
    with pytest.raises(Refused, match=r"20.0 kB.*may have 10.0 kB.*artifacts.max_size") as refusal:
        put(store, bytes(20_000))
    assert refusal.value.code == "full"


def test_a_part_without_a_begun_upload_is_not_stored(store, tmp_path):
    """Only the first question makes room, because only it comes with the references."""
    digest, data = data_of(1)
    assert store.take("ada", digest, 4000, 0, data, keep=NONE) == 0
    assert not (tmp_path / "store").exists()


def test_an_upload_that_stops_is_removed(store, clock, tmp_path):
    """Its room is free for others after a minute."""
    store.take("ada", data_of(1, 8000)[0], 8000, 0, b"", keep=NONE)
    clock.now += 61.0
    digest = put(store, data_of(2, 8000)[1])
    assert files(tmp_path) == {digest}


@pytest.mark.parametrize(("digest", "size"), [("../x", 5), ("A" * 64, 5), ("a" * 64, 0)])
def test_what_is_no_digest_is_refused(store, digest, size):
    """So no sender chooses a path."""
    with pytest.raises(Refused, match="no artifact"):
        store.take("eve", digest, size, 0, b"", keep=NONE)
    with pytest.raises(Refused) as refusal:
        store.read(digest, 0, 5)
    assert refusal.value.code == "unknown"


def test_a_restart_keeps_what_is_complete(store, tmp_path, clock):
    """Parts of unfinished uploads are removed."""
    digest = put(store, data_of(1)[1])
    store.take("ada", data_of(2)[0], 4000, 0, b"", keep=NONE)
    again = ArtifactStore(tmp_path / "store", 10_000, clock)
    assert again.has(digest, 4000)
    assert files(tmp_path) == {digest}


def test_contents_that_cannot_be_read_now_stay(store):
    """A host asks again; a process is submitted again only if its contents are lost."""
    digest, data = data_of(1)
    put(store, data)
    with no_more_files(), pytest.raises(Refused, match="Too many open files") as refusal:
        store.read(digest, 0, 100)
    assert refusal.value.code == "busy"
    assert store.read(digest, 0, 100) == (4000, data[:100])


def test_contents_that_vanished_are_unknown(store, tmp_path):
    """The next submission sends them again."""
    digest = put(store, data_of(1)[1])
    (tmp_path / "store" / digest).unlink()
    with pytest.raises(Refused, match="submit the process again"):
        store.read(digest, 0, 10)
    assert not store.has(digest, 4000)
