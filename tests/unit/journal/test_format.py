"""Journal format: a master reads the journal of an older one (tests/data/journal)."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path
from typing import Any

import pytest

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.recovery.restore import restore
from rosrm.core.master.settings import CoreSettings
from rosrm.core.master.state.images import UnwantedImage
from rosrm.core.master.state.process import WAITING
from rosrm.extensions.placement import PlacementPlugins
from rosrm.journal.sqlite import SqliteJournal
from rosrm.model.codec import to_plain
from rosrm.model.records import Intent
from rosrm.model.values import ProcessSpec

DATA = Path(__file__).parents[2] / "data" / "journal"
ROWS = [json.loads(line) for line in (DATA / "rows.jsonl").read_text().splitlines()]
INTENTS = {tuple(row["intent"][:2]): row["intent"][2] for row in ROWS if "intent" in row}
#: Unix time of the restart: 5 s after the newest row.
WALL, NOW = 1.7e9 + 149.6, 1000.0

#: Phase after the restore and owner's number of each process of the fixture.
PHASES = {
    "assigned": ("unreachable", 67),
    "backoff": ("unreachable", 6),
    "cancelled": ("cancelled", 0),
    "cannot_start": ("failed", 0),
    "checkpointed": ("checkpointed", 0),
    "checkpointing": ("migrating", 28),
    "every_field": ("set_aside", 0),
    "excluded": ("unreachable", 13),
    "failed": ("failed", 0),
    "finished": ("finished", 0),
    "handoff_released": ("migrating", 61),
    "handoff_shadowing": ("migrating", 23),
    "left_behind": ("set_aside", 0),
    "lost_and_failed": ("failed", 0),
    "move_back": ("migrating", 21),
    "move_committed": ("migrating", 55),
    "move_full": ("migrating", 22),
    "move_starting": ("migrating", 17),
    "move_stop_first": ("migrating", 18),
    "move_stuck": ("migrating", 46),
    "moved": ("unreachable", 44),
    "on_cordoned": ("unreachable", 9),
    "on_drained": ("unreachable", 10),
    "queued": ("queued", 0),
    "requeued": ("unreachable", 12),
    "restore_failed": ("checkpointed", 0),
    "restoring": ("migrating", 0),
    "running": ("unreachable", 5),
    "set_aside": ("set_aside", 0),
    "standby": ("unreachable", 26),
    "starting": ("unreachable", 50),
    "stopping": ("stopping", 7),
    "unreachable": ("unreachable", 14),
    "unwanted": ("cancelled", 0),
}

#: Fields of a process that a restored master writes differently.
_OTHER_WHEN_RESTORED = {
    "move_stop_first": {"host", "instances"},  # its source has ended, as recorded in the migration
    "move_stuck": {"phase", "since"},  # the step is retried
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Create a journal with the tables and rows of the fixture, written without rosrm."""
    path = tmp_path / "journal.sqlite"
    with sqlite3.connect(path) as database:
        database.executescript((DATA / "schema.sql").read_text())
        for row in ROWS:
            table, values = next(iter(row.items()))
            values = [*values[:-1], json.dumps(values[-1])]
            marks = ", ".join("?" * len(values))
            database.execute(f"INSERT INTO {table} VALUES ({marks})", values)
    return path


@pytest.fixture
def state(path: Path) -> MasterState:
    """Return the state of a master that was restored from the fixture."""
    state = MasterState(CoreSettings(), PlacementPlugins(), {}, epoch=4)
    state.wall = WALL
    journal = SqliteJournal(path)
    restore(state, journal.intents, NOW)
    journal.close()
    return state


def written(state: MasterState) -> dict[tuple[str, str], Any]:
    """Return the newest intents that the state has emitted."""
    intents = (one for one in state.take() if isinstance(one, Intent))
    plain = ((one, json.loads(json.dumps(one.value, default=dict))) for one in intents)
    return {(one.table, one.key): value for one, value in plain}


def with_new_fields(value: Any) -> Any:
    """Return a migration, or a part of one, with the fields of the present journal."""
    if isinstance(value, list):
        return [with_new_fields(one) for one in value]
    if not isinstance(value, dict):
        return value
    new: dict[str, Any] = {"inactive": False} if value.get("kind") == "start" else {}
    if "exit_code" in value:
        new["restarts_off"] = False
    kept = {key: one for key, one in value.items() if key != "suspended"}
    return {**new, **{key: with_new_fields(one) for key, one in kept.items()}}


def test_a_new_journal_has_the_tables_of_the_fixture(tmp_path: Path, path: Path) -> None:
    """Names, columns, index and version change only with a new version number."""
    SqliteJournal(tmp_path / "new.sqlite").close()
    schemas = []
    for file in (path, tmp_path / "new.sqlite"):
        with sqlite3.connect(file) as database:
            (version,) = database.execute("PRAGMA user_version").fetchone()
            rows = database.execute("SELECT type, name, sql FROM sqlite_schema ORDER BY name")
            schemas.append([version, *rows.fetchall()])
    assert schemas[0] == schemas[1]


def test_records_of_an_older_master_are_read_as_they_were_written(path: Path) -> None:
    """Every field of every record is equal."""
    journal = SqliteJournal(path)
    read = [
        [
            one.sequence, one.wall_time, one.elapsed, one.record.kind, one.record.process,
            one.record.host, one.record.message, one.record.facts,
        ]
        for one in journal.records()
    ]  # fmt: skip
    journal.close()
    assert read == [row["record"] for row in ROWS if "record" in row]


def test_every_process_has_its_phase_and_its_owner(state: MasterState) -> None:
    """A running process is unreachable until its host registers; the queue and moves continue."""
    found = {name: (one.phase.value, one.owner) for name, one in state.processes.items()}
    assert found == PHASES
    assert list(state.queue) == ["queued"]
    assert state.set_aside == {"set_aside", "every_field", "left_behind"}
    assert state.images.of == {"checkpointed", "restore_failed", "restoring"}


@pytest.mark.parametrize("name", PHASES)
def test_every_process_is_written_back_as_it_was_read(state: MasterState, name: str) -> None:
    """No field of its record is lost: spec, place in the line, instances, image, standby."""
    state.take()
    process = state.processes[name]
    state.save(process)
    again = written(state)["process", name]
    before = {**again, **INTENTS["process", name]}  # older journals lack some fields
    before["spec"] = {**again["spec"], **before["spec"]}
    if before["standby"]:
        absent = {"source_devices": [], "at": again["standby"]["at"]}
        before["standby"] = with_new_fields({**absent, **before["standby"]})
    if before["left_behind"]:
        known = zip(("number", "host", "node_name"), before["left_behind"], strict=True)
        before["left_behind"] = {**again["left_behind"], **dict(known)}  # a list in older journals
    changed = {field: (before[field], value) for field, value in again.items()
               if before[field] != value}  # fmt: skip
    if process.phase not in WAITING:
        changed.pop("reason", None)  # reason of the restored master for the present wait
    assert set(changed) == _OTHER_WHEN_RESTORED.get(name, set())


@pytest.mark.parametrize("name", [key for table, key in INTENTS if table == "migration"])
def test_every_migration_is_taken_up_where_it_was(state: MasterState, name: str) -> None:
    """Plan, present step, undo, results and ends are written back as they were read."""
    state.take()
    run = state.migrations[name]
    state.save_migration(run)
    after = written(state)["migration", name]
    absent = {"source_devices": [], "at": after["at"]}  # in older journals
    before = INTENTS["migration", name]
    assert after == with_new_fields({**absent, **before})
    off = {one.id.number for one in state.instances.values() if one.restarts_off}
    assert off & {run.source.number, *after["launched"]} == set(before["suspended"])
    in_hand = run.current_step
    assert in_hand is not None
    steps = {
        "checkpointing": "execute", "restoring": "execute", "handoff_released": "stop",
        "handoff_shadowing": "configure", "move_back": "stop", "move_committed": "stop",
        "move_full": "await_ready", "move_starting": "await_ready",
        "move_stop_first": "await_ready", "move_stuck": "stop",
    }  # fmt: skip
    assert to_plain(in_hand)["kind"] == steps[name]


def test_hosts_numbers_and_everything_else_are_as_they_were(state: MasterState) -> None:
    """Host flags, learned needs, removed names, unwanted images and awaited hosts are restored."""
    hosts = [(h.name, h.host_id, h.cordoned, h.draining) for h in state.hosts.hosts]
    assert hosts == [
        ("shelf", 1, False, False), ("shelf_off", 2, False, False), ("plain", 3, False, False),
        ("cordoned", 4, True, False), ("drained", 5, True, True), ("lost", 6, False, False),
        ("left", 7, False, False), ("small", 8, False, False), ("m1", 9, False, False),
        ("m2", 10, False, False),
    ]  # fmt: skip
    learned = state.learned.estimate(ProcessSpec("new", command=("run", "it")), {}).amounts
    assert learned == INTENTS["learned", "run it"]
    assert state.replication.removed == {"removed": 5}
    assert state.images.unwanted == {31: UnwantedImage("unwanted", "shelf_off", "drop", (31,))}
    assert state.next_instance == state.reserved_instances == 1001
    assert (state.journal_gap.machine_rebooted, state.journal_gap.records_missing) == (True, True)
    assert set(state.standbys) == {"standby"}
    assert list(state.wants_standby) == ["standby"]
    assert state.next_order == 1 + max(one.order for one in state.processes.values())
