"""Contracts of the complete plugins shown in docs/reference/plugins.md."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

from rosrm.extensions.registry import Registry
from rosrm.testing import (
    CheckpointContract,
    EventSinkContract,
    FilterContract,
    LauncherContract,
    ProbeContract,
)

PAGE = Path(__file__).resolve().parents[2] / "docs/reference/plugins.md"


def _module(text: str) -> ModuleType:
    name = f"shown_{hash(text)}"
    module = sys.modules[name] = ModuleType(name)  # where dataclasses look for their module
    exec(text, vars(module))
    return module


PROBE, FILTER, LAUNCHER, POLICY, SINK = map(
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


class TestSinkThatIsShown(EventSinkContract):
    offer = SINK.register_event_sinks()[0]

    @pytest.fixture(autouse=True)
    def _file(self, tmp_path):
        self.file = tmp_path / "notices.jsonl"

    def options(self):
        return {"file": str(self.file)}

    def received(self):
        return [json.loads(line)["id"] for line in self.file.read_text().splitlines()]


def test_all_are_found_by_their_hooks():
    """The plugins carry the hook marker and the function names that discovery needs."""
    registry = Registry.of(probe=PROBE, filter=FILTER, launcher=LAUNCHER, policy=POLICY, sink=SINK)
    assert not registry.broken
    assert registry.names("probe") == ("open_files",)
    assert registry.names("filter") == ("one-each",)
    assert registry.names("launcher") == ("nice",)
    assert registry.names("checkpoint") == ("first-host",)
    assert registry.names("sink") == ("lines",)
