"""The slave's note of the master's epoch, which migratable nodes read."""

from __future__ import annotations

import stat

from rosrm.node.identity import identity_from
from rosrm.runtime.path_calls import run_at_once
from rosrm.slave.epoch import EpochNote
from tests.limits import no_more_files


def known(path) -> int | None:
    variables = {
        "ROSRM_INSTANCE": "p#1", "ROSRM_STATE_CONFIG": "/rosrm/state_config",
        "ROSRM_EPOCH_FILE": str(path),
    }  # fmt: skip
    return identity_from(variables).registered_epoch()


def test_nodes_read_the_newest_epoch(tmp_path):
    """A slave that is not registered yet writes nothing; a smaller number replaces a larger one."""
    note = EpochNote(tmp_path / "epoch", run_at_once)
    note.note(0)
    assert known(tmp_path / "epoch") is None
    for epoch in (3, 2**64 - 1, 1):
        note.note(epoch)
        assert known(tmp_path / "epoch") == epoch
    assert stat.S_IMODE((tmp_path / "epoch").stat().st_mode) == 0o600


def test_a_failure_is_retried(tmp_path):
    note = EpochNote(tmp_path / "epoch", run_at_once)
    with no_more_files():
        note.note(4)
    assert known(tmp_path / "epoch") is None
    note.note(4)
    assert known(tmp_path / "epoch") == 4


def test_a_link_is_not_followed(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / "epoch").symlink_to(victim)
    EpochNote(tmp_path / "epoch", run_at_once).note(4)
    assert victim.read_text() == "precious"
