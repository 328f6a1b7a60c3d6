"""Formats of files and texts beside the journal: each literal was written by an older rosrm."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import pytest

from rosrm.core.master import events as happened
from rosrm.core.slave.watches import Awaited, LoadedComponents, ManagedLifecycle, Memo, Watch
from rosrm.model.plan import ReportPhase
from rosrm.model.requester import Requester
from rosrm.model.values import (
    Component,
    Health,
    HostDescription,
    InstanceId,
    InstanceState,
    InstanceStatus,
    ResourceDescription,
    SnapshotReport,
)
from rosrm.recording.encoding import decode, encode
from rosrm.recording.frames import FrameKind
from rosrm.recording.reader import Header
from rosrm.slave.memos import from_memo, to_memo
from rosrm_criu.control import messages as control
from rosrm_criu.engine import image
from rosrm_criu.engine.image import HeldFile, Manifest, MappedFile
from rosrm_lab.plan import HostPlan, LabPlan, parse_subnet
from rosrm_lab.store import Birth, LabRecord
from rosrm_lab.wires import Link, Wire

MEMOS = [
    (
        Memo(
            Awaited("/ns/talker", 30.0, 4711),
            Watch(Health("scan", 5.0, "active", 2.0), ("/scan",), ("/get",), False, True),
        ),
        (
            '{"awaited": ["/ns/talker", 30.0, 4711], "watch": [["scan", 5.0, "active", 2.0], '
            '["/scan"], ["/get"], false, true, []]}'
        ),
    ),
    (Memo(Awaited("/talker", 1.5)), '{"awaited": ["/talker", 1.5, 0], "watch": null}'),
    (
        Memo(lifecycle=ManagedLifecycle("active", "/n/get", "/n/set", 30.0)),
        '{"awaited": null, "watch": null, "lifecycle": ["active", "/n/get", "/n/set", 30.0]}',
    ),
    (
        Memo(loads=LoadedComponents("/c", (Component("m:C", "n"),))),
        (
            '{"awaited": null, "watch": null, "loads": {"services": "/c", "components": [{"plugin":'
            ' "m:C", "name": "n", "package": "", "namespace": "", "parameters": {}, "remappings": '
            '{}, "arguments": {}}]}}'
        ),
    ),
    (
        Memo(watch=Watch(Health())),
        '{"awaited": null, "watch": [["", 0.0, "", 0.0], [], [], true, false, []]}',
    ),
]


@pytest.mark.parametrize(("memo", "text"), MEMOS)
def test_memos_of_the_slave(memo: Memo, text: str) -> None:
    """The supervisor returns the text to a later run of the slave."""
    assert to_memo(memo) == text
    assert from_memo(text) == memo


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", '{"awaited": ["a", 1.0], "watch": 1}',
        '{"awaited": ["/n", "long", 0], "watch": null}', '{"awaited": [1.0], "watch": null}',
        '{"awaited": ["/n", 1.0, 0, 0], "watch": null}',
    ],
)  # fmt: skip
def test_a_memo_of_another_version_is_none(text: str) -> None:
    """The slave then treats the instance as one without a memo."""
    assert from_memo(text) is None


def test_an_empty_memo_takes_no_room() -> None:
    """Most instances have none."""
    assert to_memo(Memo()) == ""


STATUS = InstanceStatus(InstanceId("a", 7), InstanceState.EXITED, 0, 1, 9, 2, 1e6, 0.5, 3.0, "end")
STATUS_TEXT = (
    '{"instance":{"process":"a","number":7},"state":"exited","pid":0,"exit_code":1,'
    '"exit_signal":9,"restarts":2,"peak_memory":1000000.0,"cpu_time":0.5,"run_time":3.0,'
    '"message":"end","enforced":[],"devices":[]}'
)
EVENTS: list[tuple[happened.Event, str]] = [
    (happened.TimePassed(), '{"kind":"TimePassed"}'),
    (
        happened.MigrationRequested(3, "a", by=Requester("user:ada")),
        (
            '{"kind":"MigrationRequested","request":3,"name":"a","host":null,'
            '"by":{"name":"user:ada","is_operator":false}}'
        ),
    ),
    (
        happened.HandoffReported("a", 8, 7, ReportPhase.READY, 5, "here"),
        (
            '{"kind":"HandoffReported","process":"a","destination":8,"instance":7,"phase":12,'
            '"sequence":5,"message":"here"}'
        ),
    ),
    (
        happened.OrderAnswered(1, True, result={"ports": [1, 2], "why": None}),
        (
            '{"kind":"OrderAnswered","order":1,"accepted":true,"code":"","message":"",'
            '"result":{"ports":[1,2],"why":null}}'
        ),
    ),
    (
        happened.StatusesReceived(1, 2, 3, True, (STATUS,), {"gpu": "gone"}),
        (
            '{"kind":"StatusesReceived","host_id":1,"incarnation":2,"sequence":3,"complete":true,'
            f'"statuses":[{STATUS_TEXT}],"failing":{{"gpu":"gone"}},"failing_strategies":{{}},'
            '"failing_launchers":{},"devices":[]}'
        ),
    ),
    (
        happened.HostRegistered(
            1,
            HostDescription(
                "h", 5, labels={"arm": "yes"}, resources=(ResourceDescription("cpu", "core", 4.0),)
            ),
        ),
        (
            '{"kind":"HostRegistered","request":1,"description":{"name":"h","incarnation":5,'
            '"hostname":"","pid":0,"software_version":"","labels":{"arm":"yes"},"resources":'
            '[{"name":"cpu","unit":"core","capacity":4.0,"scope":"machine","accounting":"countable"'
            '}],"max_processes":0,"period":0.1,"executors":[],"absent":{},"unenforced":{},"cpus":[],"devices":[],'
            '"launchers":[]},"instances":[],'
            '"journal_seen":0,"snapshots":[]}'
        ),
    ),
]
SNAPSHOTS = (SnapshotReport(InstanceId("a", 7), 3, 9),)
SNAPSHOTS_TEXT = '[{"instance":{"process":"a","number":7},"sequence":3,"size":9}]'
RENAMED_EVENTS: list[tuple[happened.Event, str]] = [
    (
        happened.HostRegistered(
            1,
            HostDescription("h", 5, resources=(ResourceDescription("disk", "B", 4.0),)),
            snapshots=SNAPSHOTS,
        ),
        (
            '{"kind":"HostRegistered","request":1,"description":{"name":"h","incarnation":5,'
            '"resources":[{"name":"disk","unit":"B","capacity":4.0,"scope":"machine"}]},'
            f'"kept":{SNAPSHOTS_TEXT}}}'
        ),
    ),
    (
        happened.HostLeft(1, 2, 3, (STATUS,)),
        (f'{{"kind":"HostLeft","request":1,"host_id":2,"incarnation":3,"kept":[{STATUS_TEXT}]}}'),
    ),
    (
        happened.SnapshotsReported(2, 3, SNAPSHOTS),
        (f'{{"kind":"KeptStatesReceived","host_id":2,"incarnation":3,"states":{SNAPSHOTS_TEXT}}}'),
    ),
]


@pytest.mark.parametrize(("event", "text"), EVENTS)
def test_events_of_a_recording(event: happened.Event, text: str) -> None:
    """Two times, then JSON with the fields of the event."""
    content = struct.pack("<dd", 1.5, 1.7e9) + text.encode()
    assert encode(event, 1.5, 1.7e9) == (FrameKind.EVENT, content)
    assert decode(FrameKind.EVENT, content).event == event


@pytest.mark.parametrize(("event", "text"), RENAMED_EVENTS)
def test_events_of_a_recording_of_0_1_0(event: happened.Event, text: str) -> None:
    """Read names of that version in its recordings, and write the present ones."""
    content = struct.pack("<dd", 1.5, 1.7e9) + text.encode()
    assert decode(FrameKind.EVENT, content).event == event
    assert decode(*encode(event, 1.5, 1.7e9)).event == event


def test_a_request_of_rosrm_0_1_0_was_sent_by_an_operator() -> None:
    """Each client could do everything then, and its event has the name of the client alone."""
    text = b'{"kind":"CancelRequested","request":3,"names":["a"],"by":"cli"}'
    event = decode(FrameKind.EVENT, struct.pack("<dd", 1.5, 1.7e9) + text).event
    assert event == happened.CancelRequested(3, ("a",), Requester("cli", is_operator=True))


def test_the_header_of_a_recording() -> None:
    """Settings and journal of the recorded master, as they are."""
    header = Header("0.1", "lab", {"name": "lab"}, 3, 1.5, {"host": {"h": {"host_id": 1}}})
    assert header.encoded() == (
        b'{"software":"0.1","master":"lab","config":{"name":"lab"},"epoch":3,"started":1.5,'
        b'"intents":{"host":{"h":{"host_id":1}}}}'
    )


MANIFEST = Manifest(
    "brain", 3, "robot", 1700000000.25, "4.2.1", "6.18.0", "x86_64", 4711, (4711, 4712),
    ("/a.log",), "/a", "", "/usr/bin/python3", (HeldFile("/a/count", 6, 0o644, False, "files/0"),),
    (MappedFile("/lib/c.so", 9, 0o755),), {"files/0": 2}, {"files/0": 15},
)  # fmt: skip
MANIFEST_VALUES: dict[str, Any] = {
    "format": 2, "checksum": 2617263296, "process": "brain", "instance": 3, "host": "robot",
    "made_at": 1700000000.25, "criu": "4.2.1", "kernel": "6.18.0", "machine": "x86_64",
    "pid": 4711, "ids": [4711, 4712], "logs": ["/a.log"], "working_directory": "/a",
    "shelter": "", "interpreter": "/usr/bin/python3",
    "files": [{"path": "/a/count", "size": 6, "mode": 420, "grows": False, "copy": "files/0"}],
    "mapped": [{"path": "/lib/c.so", "size": 9, "mode": 493}], "sizes": {"files/0": 2},
    "checksums": {"files/0": 15},
}  # fmt: skip


def test_the_manifest_of_a_checkpoint_image(tmp_path: Path) -> None:
    """A restore reads the manifest that an older rosrm wrote."""
    tmp_path.chmod(0o700)
    (tmp_path / "files").mkdir(mode=0o700)
    (tmp_path / "files/0").touch(mode=0o600)
    (tmp_path / "files/0").write_bytes(b"1\n")
    image.write(tmp_path, MANIFEST)
    assert json.loads((tmp_path / image.MANIFEST).read_text()) == MANIFEST_VALUES
    (tmp_path / image.MANIFEST).write_text(json.dumps(MANIFEST_VALUES))
    assert image.read(tmp_path) == MANIFEST


def test_the_files_of_a_control_directory(tmp_path: Path) -> None:
    """Master and node may have different versions; a reader accepts fields that it lacks."""
    request, status = tmp_path / "request", tmp_path / "status"
    control.write_message(tmp_path, control.Request("r1", control.Want.LEAVE))
    assert json.loads(request.read_text()) == {"format": 1, "id": "r1", "want": "leave"}
    told = control.Status(control.State.LEFT, "r1", "why", {"leave": 0.5}, ("/scan",))
    plain = {
        "format": 1, "state": "left", "request": "r1", "fault": "why", "seconds": {"leave": 0.5},
        "missing": ["/scan"],
    }  # fmt: skip
    control.write_message(tmp_path, told)
    assert json.loads(status.read_text()) == plain
    status.write_text(json.dumps({**plain, "newer": 1}))
    assert control.read_message(tmp_path, control.Status) == told
    request.write_text('{"format": 1, "id": "r2", "want": "join", "newer": 1}')
    assert control.read_message(tmp_path, control.Request) == control.Request(
        "r2", control.Want.JOIN
    )


def test_the_state_file_of_a_lab() -> None:
    """A command finds the lab that another version made."""
    plan = LabPlan("lab", (HostPlan("h1", 2**30, 0.5, 2**30),), parse_subnet("10.9.0.0/24"))
    link = Link(Wire(True, 0.0, 0.0), Wire(False, 0.25, 0.5))
    record = LabRecord(plan, True, "boot", Birth(1, 2), {"h1": Birth(3, 4)}, {"h1": link})
    plain = {
        "version": 1,
        "plan": {
            "name": "lab", "subnet": "10.9.0.0/24", "hosts": [["h1", 2**30, 0.5, 2**30]],
        },
        "complete": True, "boot": "boot", "owner": [1, 2], "inits": {"h1": [3, 4]},
        "links": {"h1": [[True, 0.0, 0.0], [False, 0.25, 0.5]]},
    }  # fmt: skip
    assert json.loads(json.dumps(record.to_plain())) == plain
    assert LabRecord.from_plain(plain) == record
