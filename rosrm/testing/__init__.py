"""For authors of plugins: fakes, and contracts as test classes to inherit.

A contract is what the core relies on; rosrm's own plugins pass the same ones. With pytest::

    from rosrm.testing import ProbeContract
    from thermometer.plugin import register_probes

    class TestThermometer(ProbeContract):
        offer = register_probes()[0]
        options = {"sensor": "cpu"}

`options` is written as in a file of the configuration: `{"period": "500ms"}` is allowed. Each call
has the time limit that rosrm grants, and a failure says in a sentence what is wrong. Where a plugin
says that it is absent (`SkipPlugin`), its contract is skipped with that reason.
"""

from rosrm.extensions.registry import Registry
from rosrm.testing.checkpoints import CheckpointContract
from rosrm.testing.journals import JournalContract, MemoryJournal
from rosrm.testing.launchers import LauncherContract
from rosrm.testing.migrations import MigrationContract, before_commit, with_options
from rosrm.testing.probes import (
    FakeClock,
    FakeProbe,
    FakeSessions,
    ProbeContract,
    made_probe,
    probe_context,
)
from rosrm.testing.scoring import ScoringContract, host_view, one_row, process_view, vetoes

__all__ = [
    "CheckpointContract",
    "FakeClock",
    "FakeProbe",
    "FakeSessions",
    "JournalContract",
    "LauncherContract",
    "MemoryJournal",
    "MigrationContract",
    "ProbeContract",
    "Registry",
    "ScoringContract",
    "before_commit",
    "host_view",
    "made_probe",
    "one_row",
    "probe_context",
    "process_view",
    "vetoes",
    "with_options",
]
