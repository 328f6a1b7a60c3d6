"""Decoders of binary data: readings, snapshots, recordings, archives, arrays, CRIU's images."""

from __future__ import annotations

import contextlib
import io
import tarfile
import tempfile
import zlib
from collections import deque
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.core.master import events as happened
from rosrm.errors import CriuError, RecordError, TransferError
from rosrm.model.requester import Requester
from rosrm.node.arrays import arrays_message, arrays_of
from rosrm.recording.encoding import encode, encode_decisions
from rosrm.recording.frames import FrameKind, frame, opening
from rosrm.recording.reader import Header, read_record
from rosrm.ros.master.reading_decoder import decode
from rosrm.ros.reading_codec import Reading
from rosrm.ros.reading_codec import encode as encode_reading
from rosrm.snapshots.format import Block, Damaged, checked, decoded, encoded_head
from rosrm.snapshots.reader import newest, newest_content, newest_head
from rosrm.supervisor import log_index
from rosrm_criu.engine import protobuf, received, relocation
from rosrm_criu.transfer.archive import Archive, Unpacker
from rosrm_criu.transfer.receiving import _Stream
from rosrm_msgs.msg import Arrays
from tests.fuzz.hostile import damaged_bytes, fuzzed, uint64s
from tests.unit.criu.test_received import core, credentials
from tests.unit.criu.test_relocation import image_of
from tests.unit.test_transfer import OFFER, Chunks, tree, zstd

# --- readings ----------------------------------------------------------------------------------


def reading() -> bytes:
    return encode_reading(Reading(host_id=1, incarnation=7))


@fuzzed(150)
@given(messages=st.lists(damaged_bytes(reading()) | st.just(reading()), max_size=5))
def test_readings_are_decoded_or_refused(messages):
    """The arrays of a batch have equal lengths, and no host has two readings of one run."""
    batch = decode(messages)
    assert len(batch.refusals) <= len(messages) + 1
    if batch.readings is None:
        assert batch.runs is None
        return
    columns = [getattr(batch.readings, name) for name in happened.ReadingsReceived.__slots__]
    assert len({len(column) for column in columns}) == 1
    assert len(batch.runs.host_id) == len(batch.readings.host_id) <= len(messages)


# --- snapshots ---------------------------------------------------------------------------------


def snapshot(*contents: bytes) -> bytes:
    blocks = [Block(content, zlib.crc32(content)) for content in contents]
    return encoded_head("p", 3, 7, blocks) + b"".join(contents)


@fuzzed(150)
@given(data=damaged_bytes(snapshot(b"mark", b"state" * 20)), other=damaged_bytes(snapshot(b"m")))
def test_a_snapshot_is_read_or_damaged(data, other):
    """No snapshot has content that its checksums do not cover."""
    with contextlib.suppress(Damaged):
        head, _ = checked(data)
        assert head.size <= len(data)
        assert [len(block) for block in decoded(data).blocks] == [size for size, _ in head.blocks]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "state.0").write_bytes(data)
        (place / "state.1").write_bytes(other)
        newest_head(place)
        newest_content(place)
        found, faults = newest(place, 5)
        assert found is None or found.head.instance <= 5
        assert all(isinstance(fault, str) for fault in faults)


# --- recordings --------------------------------------------------------------------------------


def recording() -> bytes:
    readings = happened.ReadingsReceived(
        np.array([1]), np.array([7], np.uint64), np.array([2], np.uint64), np.array([0], np.uint64),
        np.array([True]), np.array([0], np.uint32), np.zeros((1, 16)), np.ones((1, 16)),
    )  # fmt: skip
    usages = happened.UsagesReceived(
        1, 7, np.array([1], np.uint64), np.array([0.5]), np.array([1.0]), {2: np.array([3.0])}
    )
    parts = [opening(), frame(FrameKind.HEADER, Header("0", "m", {}, 1, 0.0, {}).encoded())]
    request = happened.CancelRequested(1, ("p",), Requester("user:ada"))
    for number, event in enumerate((readings, usages, request, happened.TimePassed())):
        parts.append(frame(*encode(event, float(number), 1.0)))
    parts.append(frame(FrameKind.DECISIONS, encode_decisions(["assign p#1 to host 1"])))
    return b"".join([*parts, frame(FrameKind.END, b"stopped")])


RECORDING = recording()


@fuzzed(100)
@given(data=damaged_bytes(RECORDING), cut=st.booleans())
def test_a_recording_is_read_or_refused(data, cut):
    with contextlib.suppress(RecordError):
        read_record(io.BytesIO(data), "r", cut=cut)


@fuzzed(150)
@given(
    kind=st.sampled_from(list(FrameKind)),
    content=st.sampled_from([RECORDING[30:400], b"[]", b"{}", b'{"kind":"TimePassed"}',
                             bytes(16) + b'{"kind":"RestoreRequested","name":"p","by":""}'])
    .flatmap(damaged_bytes) | st.just(b"[").map(lambda one: one * 50_000),
)  # fmt: skip
def test_a_frame_whose_checksum_fits_is_read_or_refused(kind, content):
    """A hostile writer computes checksums too."""
    end = len(opening()) + 8 + 1 + len(Header("0", "m", {}, 1, 0.0, {}).encoded())
    data = RECORDING[:end] + frame(kind, content) + frame(FrameKind.END, b"stopped")
    with contextlib.suppress(RecordError):
        read_record(io.BytesIO(data), "r")


# --- arrays ------------------------------------------------------------------------------------

ARRAYS = bytes(arrays_message({"a": np.arange(6).reshape(2, 3), "b": np.array("text")}).npz)


@fuzzed(150)
@given(data=damaged_bytes(ARRAYS))
def test_arrays_are_read_or_refused(data):
    with contextlib.suppress(ValueError):
        found = arrays_of(Arrays(npz=data))
        assert sum(one.nbytes for one in found.values()) <= 64 * len(data) + 4096
        assert not any(one.dtype.hasobject for one in found.values())


# --- transfers ---------------------------------------------------------------------------------


def archive() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "from").mkdir()
        return b"".join(Archive(tree(Path(folder) / "from")).pieces())


@fuzzed(60)
@given(
    data=st.sampled_from([archive()[:3000], archive()[-5000:]]).flatmap(damaged_bytes),
    files=st.integers(0, 8),
)
def test_an_archive_is_unpacked_or_refused(data, files):
    """Nothing comes to lie outside, and nothing but files and directories inside."""
    with tempfile.TemporaryDirectory() as folder:
        inside = Path(folder) / "inside"
        inside.mkdir()
        with contextlib.suppress(TransferError, OSError):
            Unpacker(Chunks(zstd.compress(data)), len(data), files).unpack(inside)
        assert [path.name for path in Path(folder).iterdir()] == ["inside"]
        found = list(inside.rglob("*"))
        assert all(not one.is_symlink() and (one.is_dir() or one.is_file()) for one in found)
        assert sum(one.stat().st_size for one in found if one.is_file()) <= len(data)
        assert sum(one.is_file() for one in found) <= files


class Connection:
    """Connection that delivers some bytes in small pieces, and then its end."""

    def __init__(self, data: bytes) -> None:
        self._file = io.BytesIO(data)

    def settimeout(self, seconds: float) -> None:
        assert seconds > 0.0

    def recv(self, size: int) -> bytes:
        return self._file.read(min(size, 7))


STREAM = b"\0\0\0\x05hello\0\0\0\x03abc\0\0\0\0the disk is full"


@fuzzed(100)
@given(data=damaged_bytes(STREAM) | st.binary(max_size=12))
def test_a_stream_of_parts_is_read_or_refused(data):
    """Each ends with an error here, because no reader has enough."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_Stream, "_connect", lambda *_: (Connection(data), "10.0.0.1"))
        patch.setattr("rosrm_criu.transfer.receiving._context", lambda _: None)
        stream = _Stream(OFFER, timeout=60.0, identity=None)
        with pytest.raises(TransferError):
            deque(iter(stream.read, b""))
        assert stream.received <= len(data)


@st.composite
def headers(draw):
    """Draw one header of a tar archive, sound but for the values of its fields."""
    entry = tarfile.TarInfo(
        draw(st.sampled_from(["a", "a/b", "../a", "/a", "", "é", "x" * 200, "a/"]))
    )
    entry.type = draw(st.sampled_from([b"0", b"5", b"x", b"g", b"1", b"2", b"L", b"S", b"\0"]))
    entry.size = draw(st.sampled_from([0, 1, 512, 70_000, (1 << 33) - 1, 1 << 40]))
    fields = {"path": "b", "size": "3", "GNU.sparse.map": "0,1", "linkpath": "/etc"}
    entry.pax_headers = {
        name: fields[name] for name in draw(st.lists(st.sampled_from(sorted(fields)), max_size=2))
    }
    return entry.tobuf(tarfile.PAX_FORMAT, "utf-8", "surrogateescape")


@fuzzed(60)
@given(pieces=st.lists(headers() | st.just(bytes(512)) | st.just(b"x" * 512), max_size=5))
def test_headers_with_sound_checksums_are_unpacked_or_refused(pieces):
    data = b"".join(pieces) + bytes(1024)
    with tempfile.TemporaryDirectory() as folder:
        inside = Path(folder) / "inside"
        inside.mkdir()
        with contextlib.suppress(TransferError, OSError):
            Unpacker(Chunks(zstd.compress(data)), len(data), 3).unpack(inside)
        assert [path.name for path in Path(folder).iterdir()] == ["inside"]
        assert not any(path.is_symlink() for path in inside.rglob("*"))


# --- CRIU's images -----------------------------------------------------------------------------


@fuzzed(100)
@given(data=st.sampled_from([core(credentials()), image_of("/a/work/x")]).flatmap(damaged_bytes))
def test_an_image_file_of_criu_is_read_or_damaged(data):
    with contextlib.suppress(ValueError, CriuError):
        for one in received._credentials(data):
            received._check_rights(one, 1000)
    with contextlib.suppress(ValueError):
        for message in protobuf.messages(data):
            assert b"".join(one.raw for one in protobuf.fields(message)) == message
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "criu").mkdir()
        (Path(folder) / "criu/files.img").write_bytes(data)
        with (
            contextlib.suppress(CriuError),
            relocation.images(Path(folder) / "criu", "/a/work", "/b"),
        ):
            pass


# --- logs --------------------------------------------------------------------------------------


@fuzzed(60)
@given(data=st.binary(max_size=80) | uint64s.map(lambda one: one.to_bytes(8, "little") * 6))
def test_an_index_of_a_log_is_read_whatever_it_holds(data):
    with tempfile.TemporaryDirectory() as folder:
        log = str(Path(folder) / "p.1.log")
        Path(log_index.path_of(log)).write_bytes(data)
        with log_index.Index(log) as index:
            assert 0 <= index.find(lambda mark: mark.offset > 5) <= index.count
            assert len(index.marks(0, 4)) <= 4
        log_index.add(log, log_index.Mark(1.0, 2, 3))
