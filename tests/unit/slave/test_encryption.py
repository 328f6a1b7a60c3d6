"""Encrypted replicas: the host that stores one can neither read nor change it."""

from __future__ import annotations

import json
import os
import stat
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.keys.derivation import derived
from rosrm.slave.replication import encryption
from rosrm.slave.replication.encryption import decrypted, encrypted
from rosrm.slave.replication.keys import KEY, StateKeys
from rosrm.snapshots.format import Block, Damaged, Head, checked, decoded, encoded_head
from rosrm.snapshots.writer import SlotWriter

VECTOR = Path(__file__).parents[2] / "data" / "keys" / "replica.json"
ONE, OTHER = bytes(range(32)), bytes(32)
CHANGED = "it was changed, or encrypted with another key"


def snapshot(content: bytes = b"secret state", process: str = "p") -> tuple[Head, bytes]:
    data = encoded_head(process, 7, 42, [Block(content, zlib.crc32(content))]) + content
    return checked(data)[0], data


def stored(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def renamed(data: bytes, **facts) -> bytes:
    """Return a replica whose header has other facts, with valid checksums."""
    read = decoded(data)
    head = replace(read.head, **facts)
    blocks = [Block(one, zlib.crc32(one)) for one in read.blocks]
    first = encoded_head(
        head.process, head.instance, head.sequence, blocks, encrypted=head.encrypted
    )
    return first + b"".join(read.blocks)


# --- one replica --------------------------------------------------------------------------------


@given(content=st.binary(max_size=500), process=st.text(max_size=20))
def test_what_is_encrypted_is_decrypted(tmp_path_factory, content, process):
    """The header names process, instance and sequence, and 40 bytes and a header are added."""
    head, data = snapshot(content, process)
    replica = encrypted(ONE, head, data)
    seen = decoded(replica).head
    assert (seen.process, seen.age, seen.encrypted) == (process, head.age, True)
    assert len(replica) == seen.size == len(data) + 40 + len(encoded_head(process, 7, 42, ())) + 24
    path = stored(tmp_path_factory.mktemp("r") / "copy", replica)
    assert decrypted(ONE, path) == data


def test_the_format_is_that_of_the_test_vector(tmp_path, monkeypatch):
    """Slaves of other releases, and in other languages, read the same bytes."""
    vector = json.loads(VECTOR.read_text())
    key, data = bytes.fromhex(vector["key"]), bytes.fromhex(vector["snapshot"])
    assert key == derived(bytes.fromhex(vector["secret"]), "state", vector["process"])
    monkeypatch.setattr(os, "urandom", lambda size: bytes.fromhex(vector["nonce"])[:size])
    replica = encrypted(key, checked(data)[0], data)
    assert replica.hex() == vector["replica"]
    assert decrypted(key, stored(tmp_path / "copy", replica)) == data


def test_a_replica_shows_nothing_of_the_state():
    """The same state encrypted twice has no bytes in common either: the nonce is random."""
    head, data = snapshot(b"secret" * 100)
    first, second = encrypted(ONE, head, data), encrypted(ONE, head, data)
    assert b"secret" not in first
    assert decoded(first).blocks[1][:64] != decoded(second).blocks[1][:64]


@pytest.mark.parametrize(
    "facts",
    [{"process": "q"}, {"instance": 8}, {"sequence": 43}],
    ids=lambda facts: next(iter(facts)),
)
def test_a_replica_under_another_name_or_age_is_refused(tmp_path, facts):
    """The keeper cannot give an old state as a new one, nor one process's as another's."""
    head, data = snapshot()
    path = stored(tmp_path / "copy", renamed(encrypted(ONE, head, data), **facts))
    with pytest.raises(Damaged, match=CHANGED):
        decrypted(ONE, path)


def test_a_replica_of_another_version_is_refused(tmp_path, monkeypatch):
    head, data = snapshot()
    monkeypatch.setattr(encryption, "_VERSION", b"rosrm snapshot 2")
    path = stored(tmp_path / "copy", encrypted(ONE, head, data))
    monkeypatch.undo()
    with pytest.raises(Damaged, match=CHANGED):
        decrypted(ONE, path)


def test_a_replica_under_another_key_is_refused(tmp_path):
    path = stored(tmp_path / "copy", encrypted(OTHER, *snapshot()))
    with pytest.raises(Damaged, match=CHANGED):
        decrypted(ONE, path)


@given(data=st.data())
def test_no_change_of_the_state_or_nonce_goes_unseen(tmp_path_factory, data):
    """The keeper can compute the checksums of the header again, and not the tag."""
    blocks = list(decoded(encrypted(ONE, *snapshot())).blocks)
    which = data.draw(st.integers(0, 1))
    at = data.draw(st.integers(0, len(blocks[which]) - 1))
    other = bytes([blocks[which][at] ^ data.draw(st.integers(1, 255))])
    blocks[which] = blocks[which][:at] + other + blocks[which][at + 1 :]
    assert fault_of(tmp_path_factory.mktemp("r"), blocks) == CHANGED


@pytest.mark.parametrize(
    ("blocks", "fault"),
    [
        ([], "it has other parts than an encrypted replica"),
        ([b"n" * 23, b"x" * 99], "it has other parts than an encrypted replica"),
        ([b"n" * 24, b"x" * 99, b""], "it has other parts than an encrypted replica"),
        ([b"n" * 24, b"x" * 15], CHANGED),
        ([b"n" * 24, b""], CHANGED),
    ],
)
def test_a_replica_of_other_parts_is_refused(tmp_path, blocks, fault):
    assert fault_of(tmp_path, blocks) == fault


def fault_of(directory: Path, blocks: list[bytes]) -> str:
    parts = [Block(one, zlib.crc32(one)) for one in blocks]
    data = encoded_head("p", 7, 42, parts, encrypted=True) + b"".join(blocks)
    with pytest.raises(Damaged) as caught:
        decrypted(ONE, stored(directory / "copy", data))
    return str(caught.value)


def test_a_plain_replica_is_refused_where_the_process_has_a_key(tmp_path):
    path = stored(tmp_path / "copy", snapshot()[1])
    with pytest.raises(Damaged, match="it is not encrypted, and this process has a key"):
        decrypted(ONE, path)


# --- the keys of this host ----------------------------------------------------------------------


@pytest.fixture
def keys(tmp_path) -> StateKeys:
    return new_run(tmp_path)


def new_run(root: Path) -> StateKeys:
    return StateKeys(lambda process: root / process)


def save(keys: StateKeys, **taken: tuple[int, bytes]) -> None:
    """Take keys of processes, and store them as for a start of the first process."""
    for process, (number, key) in taken.items():
        keys.put(process, number, key)
    keys.save(next(iter(taken)))


def test_the_next_run_of_the_slave_finds_the_key(keys, tmp_path):
    """The file can be read by its owner alone."""
    assert keys.of("p") == b""
    save(keys, p=(7, ONE))
    assert new_run(tmp_path).of("p") == ONE
    assert stat.S_IMODE((tmp_path / "p" / KEY).stat().st_mode) == 0o600
    save(keys, p=(8, OTHER))
    assert new_run(tmp_path).of("p") == OTHER
    keys.delete("p")
    assert new_run(tmp_path).of("p") == b""
    assert list(tmp_path.iterdir()) == []


def test_a_key_lasts_as_long_as_the_snapshots_of_its_instances(keys, tmp_path):
    save(keys, p=(7, ONE))
    writer = SlotWriter(tmp_path / "p", "p", 7)
    writer.close()
    keys.drop("p", 7)
    assert keys.of("p") == ONE
    for path in (tmp_path / "p").glob("state.*"):
        path.unlink()
    keys.drop("p", 6)
    assert keys.of("p") == ONE
    keys.drop("p", 7)
    assert keys.of("p") == b""
    assert list(tmp_path.iterdir()) == []


def test_a_key_that_cannot_be_saved_is_not_used(keys, tmp_path):
    """The next run of the slave would not have the key, and send plain snapshots."""
    (tmp_path / "p").write_text("in the way")
    save(keys, q=(8, OTHER), p=(7, ONE))  # those that wait at the same time are saved
    assert new_run(tmp_path).of("q") == OTHER
    for wants in (keys.save, keys.of):
        with pytest.raises(NotADirectoryError):
            wants("p")
    (tmp_path / "p").unlink()
    assert keys.of("p") == new_run(tmp_path).of("p") == ONE


@pytest.mark.parametrize("content", [b"", struct.pack("<Q", 7), bytes(41)])
def test_a_damaged_file_is_no_missing_key(keys, tmp_path, content):
    """Snapshots would otherwise be sent without encryption."""
    (tmp_path / "p").mkdir()
    stored(tmp_path / "p" / KEY, content)
    with pytest.raises(Damaged, match="holds no key"):
        keys.of("p")
    keys.put("p", 8, ONE)
    assert keys.of("p") == ONE


def test_a_link_is_no_key(keys, tmp_path):
    (tmp_path / "p").mkdir()
    os.symlink(stored(tmp_path / "elsewhere", bytes(40)), tmp_path / "p" / KEY)  # noqa: PTH211
    with pytest.raises(OSError, match="symbolic link"):
        keys.of("p")
