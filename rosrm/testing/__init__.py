"""Test support for authors of plugins: fakes, and contracts as test classes to inherit.

A contract tests the guarantees on which the core relies; rosrm's own plugins pass it too. With
pytest::

    from rosrm.testing import ProbeContract
    from thermometer.plugin import register_probes

    class TestThermometer(ProbeContract):
        offer = register_probes()[0]
        options = {"sensor": "cpu"}

`options` has the form of a configuration file: `{"period": "500ms"}` is allowed. Each call has the
time limit of master or slave, and a failure describes the error in a sentence. If a plugin reports
itself absent (`SkipPlugin`), its contract is skipped with that reason.
"""

from rosrm.extensions.registry import Registry
from rosrm.testing.checkpoints import CheckpointContract
from rosrm.testing.event_sinks import EventSinkContract
from rosrm.testing.filters import FilterContract
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
from rosrm.testing.scoring import (
    ScoringContract,
    flow_view,
    host_view,
    one_row,
    process_view,
    vetoes,
)

__all__ = [
    "CheckpointContract",
    "EventSinkContract",
    "FakeClock",
    "FakeProbe",
    "FakeSessions",
    "FilterContract",
    "JournalContract",
    "LauncherContract",
    "MemoryJournal",
    "MigrationContract",
    "ProbeContract",
    "Registry",
    "ScoringContract",
    "before_commit",
    "flow_view",
    "host_view",
    "made_probe",
    "one_row",
    "probe_context",
    "process_view",
    "vetoes",
    "with_options",
]
