"""Contracts of the complete plugins shown in docs/reference/plugins.md."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType

from rosrm.extensions.registry import Registry
from rosrm.testing import CheckpointContract, FilterContract, LauncherContract, ProbeContract

PAGE = Path(__file__).resolve().parents[2] / "docs/reference/plugins.md"


def _module(text: str) -> ModuleType:
    module = ModuleType("shown")
    exec(text, vars(module))
    return module


PROBE, FILTER, LAUNCHER, POLICY = map(
    _module,
    re.findall(
        r"<!-- plugin -->\n```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL
    ),
)


class TestProbeThatIsShown(ProbeContract):
    offer = PROBE.register_probes()[0]


class TestFilterThatIsShown(FilterContract):
    offer = FILTER.register_filters()[0]


class TestCheckpointPolicyThatIsShown(CheckpointContract):
    offer = POLICY.register_checkpoint_policies()[0]


class TestLauncherThatIsShown(LauncherContract):
    offer = LAUNCHER.register_launchers()[0]


def test_all_are_found_by_their_hooks():
    """The plugins carry the hook marker and the function names that discovery needs."""
    registry = Registry.of(probe=PROBE, filter=FILTER, launcher=LAUNCHER, policy=POLICY)
    assert not registry.broken
    assert registry.names("probe") == ("open_files",)
    assert registry.names("filter") == ("one-each",)
    assert registry.names("launcher") == ("nice",)
    assert registry.names("checkpoint") == ("first-host",)
