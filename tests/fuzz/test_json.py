"""Readers of JSON: of the journal, of plans and memos, of the supervisor's lines and records."""

from __future__ import annotations

import contextlib
import json
import tempfile
import zlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.config.settings import ClusterConfig, HostConfig, Quota
from rosrm.core.master.state.migration import End
from rosrm.core.master.state.process import Image, LeftBehind
from rosrm.core.slave.watches import Awaited, Memo, Watch
from rosrm.core.supervisor import events as told
from rosrm.core.supervisor.instance import Instance
from rosrm.core.supervisor.rules import FenceRule, RestartRule, RunLimits, StopRule
from rosrm.errors import CriuError, PortableError, TransferError
from rosrm.model.codec import from_plain, to_plain
from rosrm.model.plan import Commit, Execute, Plan, Start, Stop
from rosrm.model.values import Health, InstanceId, InstanceState, InstanceStatus, ProcessSpec
from rosrm.slave.memos import from_memo, to_memo
from rosrm.supervisor import instance_record, messages, paths, procfs
from rosrm.supervisor.json_lines import LONGEST_LINE, LineSplitter, ProtocolError, line
from rosrm.supervisor.logs import LogLimits
from rosrm_criu.control.messages import FORMAT, Request, Status, read_message
from rosrm_criu.engine import image, restore_result
from rosrm_criu.engine.restore_result import Outcome
from rosrm_criu.options import OwnCriuOptions
from rosrm_criu.transfer import Offer
from rosrm_migration.handoff import HandoffOptions
from tests.fuzz.hostile import damaged_bytes, damaged_json, damaged_text, fuzzed, values_of
from tests.unit.criu.test_image import FILES, MANIFEST, written
from tests.unit.test_transfer import OFFER

P1, P2 = InstanceId("p", 1), InstanceId("p", 2)
PLAN = Plan(
    (
        Start(P2, "b", 5.0, undo=Stop(P2, "b", 5.0)),
        Execute("x", "a", {"number": 1}, 5.0),
        Commit(),
        Stop(P1, "a", 5.0),
    )
)
STORED = [
    PLAN, ProcessSpec("p", command=("run",), needs={"memory": 1.0}), LeftBehind, Image, End,
    Memo(Awaited("/n", 5.0), Watch(Health())), InstanceStatus(P1, InstanceState.READY),
    ClusterConfig(quotas={"ada": Quota(1, 1e9, 0.5)}), HostConfig(), OwnCriuOptions(),
    HandoffOptions(), MANIFEST,
]  # fmt: skip


@pytest.mark.parametrize(
    "stored", STORED, ids=lambda one: getattr(one, "__name__", type(one).__name__)
)
@fuzzed(40)
@given(data=st.data())
def test_a_dataclass_is_read_or_refused(stored, data):
    """`ValueError` is the only refusal, and what is read has the types of its fields."""
    kind = stored if isinstance(stored, type) else type(stored)
    sound = {} if isinstance(stored, type) else json.loads(json.dumps(to_plain(stored)))
    plain = json.loads(json.dumps(data.draw(damaged_json(sound))))
    with contextlib.suppress(ValueError):
        found = from_plain(kind, plain)
        assert from_plain(kind, json.loads(json.dumps(to_plain(found)))) is not None


@pytest.mark.parametrize(
    "kind",
    [LeftBehind, Image, End, Memo, InstanceStatus, ProcessSpec, Plan],
    ids=lambda one: one.__name__,
)
@fuzzed(40)
@given(data=st.data())
def test_what_is_written_is_read_again(kind, data):
    """Whatever value is in the state, a journal with it can be read."""
    found = data.draw(values_of(kind, {"undo": st.none()}))  # else plans without end
    text = json.dumps(to_plain(found))
    assert json.dumps(to_plain(from_plain(kind, json.loads(text)))) == text


@fuzzed(100)
@given(text=damaged_text(json.loads(to_memo(STORED[5]))))
def test_a_memo_is_read_or_left_out(text):
    memo = from_memo(text.decode(errors="replace"))
    assert memo is None or isinstance(memo, Memo)


# --- the supervisor's socket -------------------------------------------------------------------

KEY = ("p", 1)
ORDERS = [
    messages.Hello(3, 7, LogLimits()),
    messages.Environment("e", {"A": "b"}),
    messages.Launch(
        KEY, ("run", "it"), "e", {"A": None}, "/work", RestartRule(), StopRule(), "memo",
        FenceRule(1.0, 1.0), 2.0,
    ),
    told.StopOrdered(KEY), told.FenceOrdered(KEY), told.ContactReported(1.0, 2.0),
    told.RestartOrdered(KEY), told.FailOrdered(KEY, 7, "ill"),
    messages.Amend(KEY, RestartRule(), {"A": "b"}, RunLimits(1e9, 0.0, 1.0, required=True)),
    messages.Remember(KEY, "memo"), messages.Forget((told.StatusStored(KEY),)),
    told.ShutdownOrdered(),
]  # fmt: skip


@pytest.mark.parametrize("order", ORDERS, ids=lambda one: type(one).__name__)
@fuzzed(60)
@given(data=st.data())
def test_a_line_of_the_slave_is_read_or_refused(order, data):
    text = data.draw(damaged_text(json.loads(messages.encode_order(order))))
    with contextlib.suppress(ProtocolError):
        found = messages.decode_order(text)
        assert messages.decode_order(messages.encode_order(found)) is not None


@fuzzed(60)
@given(pieces=st.lists(damaged_bytes(b'{"do":"stop"}\n{"do":"shutdown"}\n'), max_size=5))
def test_lines_are_split_wherever_the_stream_is_cut(pieces):
    splitter = LineSplitter()
    lines = [line for piece in pieces for line in splitter.feed(piece)]
    whole = b"".join(pieces).split(b"\n")
    assert lines == whole[:-1]


def test_a_line_without_end_is_refused_and_not_kept():
    splitter = LineSplitter()
    assert splitter.feed(bytes(LONGEST_LINE)) == []
    with pytest.raises(ProtocolError, match="longer than"):
        splitter.feed(b"x")


# --- the supervisor's record -------------------------------------------------------------------


def record_lines() -> list[bytes]:
    """Return the lines of a record with one of each kind."""
    instance = Instance(KEY, RestartRule(), StopRule())
    state = {name: getattr(instance, name) for name in Instance.__slots__}
    return [
        line({"record": "header", "version": 1, "boot": procfs.boot_id()}),
        line({"record": "environment", "id": "e", "variables": {"A": "b"}}),
        line({"record": "order", **messages.launch_fields(ORDERS[2])}),
        line({"record": "spawning", "instances": [KEY]}),
        line({"record": "state", "birth": 1, **state}),
        line({"record": "dead", "key": KEY, "process": "p", "number": 1}),
    ]


LINES = record_lines()


#: Lines, of which some are damaged.
TORN = st.sampled_from(LINES) | st.sampled_from(LINES).flatmap(
    lambda one: damaged_text(json.loads(one)).map(lambda text: text + b"\n")
)


@fuzzed(150)
@given(text=st.lists(TORN, max_size=4).map(b"".join))
def test_a_record_is_read_with_notes_of_what_is_damaged(text):
    """A damaged line costs this line alone: each successor reads the record again."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / paths.RECORD).write_bytes(text)
        found = instance_record.read(folder)
    for note in found.notes:
        assert isinstance(note, str)
    for key, instance in found.instances.items():
        assert instance.key == key


# --- images, offers, requests to nodes ---------------------------------------------------------


@fuzzed(100)
@given(data=st.data())
def test_a_manifest_is_read_or_refused(data):
    """Also one whose checksum fits, as a hostile source would write it."""
    with written() as directory:
        path = directory / image.MANIFEST
        sound = json.loads(path.read_text())
        text = data.draw(damaged_text(sound))
        with contextlib.suppress(ValueError, RecursionError):
            values = json.loads(text)
            if isinstance(values, dict):
                values.pop("checksum", None)
                rest = {name: one for name, one in values.items() if name != "format"}
                values["checksum"] = zlib.crc32(json.dumps(rest, sort_keys=True).encode())
                text = json.dumps(values).encode()
        path.write_bytes(text)
        with contextlib.suppress(CriuError):
            found = image.read(directory)
            image.check_contents(directory, found)
            assert set(found.sizes) <= set(FILES)


@fuzzed(100)
@given(plain=damaged_json(OFFER.as_json()))
def test_an_offer_is_read_or_refused(plain):
    plain = json.loads(json.dumps(plain))
    with contextlib.suppress(TransferError):
        found = Offer.from_json(plain)
        assert 0 < found.port < 1 << 16
        assert 0 <= found.files <= 100_000


@pytest.mark.parametrize("kind", [Request, Status])
@fuzzed(60)
@given(data=st.data())
def test_a_message_in_a_control_directory_is_read_or_nothing(kind, data):
    """The node may belong to another user than the slave that reads."""
    sound = {"format": FORMAT, "id": "r", "want": "leave", "state": "left", "missing": []}
    text = data.draw(damaged_text(sound))
    with tempfile.TemporaryDirectory() as folder:
        for name in ("request", "status"):
            (Path(folder) / name).write_bytes(text)
        with contextlib.suppress(PortableError):
            found = read_message(Path(folder), kind)
            assert found is None or isinstance(found, kind)


@fuzzed(60)
@given(text=damaged_text(to_plain(Outcome(pid=7))))
def test_a_result_of_a_restore_is_read_or_refused(text):
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / restore_result.FILE).write_bytes(text)
        with contextlib.suppress(CriuError):
            restore_result.read(Path(folder))
        assert restore_result.was_restored(Path(folder)) in (True, False)
