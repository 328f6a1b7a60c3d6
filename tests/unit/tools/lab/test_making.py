"""Creation of hosts, without root: the machine's part is replaced."""

from __future__ import annotations

from ipaddress import IPv4Network
from pathlib import Path

import pytest

from rosrm.errors import LabError
from rosrm_lab import host, making, store
from rosrm_lab.plan import LabPlan, uniform
from rosrm_lab.store import LabRecord
from rosrm_lab.wires import Link

PLAN = LabPlan("lab", tuple(uniform(1)), IPv4Network("10.9.8.0/24"))


def refuse(*_: object) -> None:
    raise LabError("not ready in 30 s")


def test_a_host_that_cannot_be_booted_is_switched_off(monkeypatch):
    """Its first process may run already, with its mounts and its network."""
    done: list[str] = []
    monkeypatch.setattr(making, "switch_off", lambda *_: done.append("switch_off"))
    monkeypatch.setattr(making.network, "plug_in", lambda *_: done.append("plug_in"))
    monkeypatch.setattr(making, "boot", refuse)
    record = LabRecord(PLAN, links={"host1": Link()})
    with pytest.raises(LabError, match="not ready"):
        making.switch_on([], record, "host1")
    assert done == ["switch_off", "plug_in", "switch_off"]
    assert record.inits == {}


def test_a_missing_program_costs_no_descriptor(monkeypatch, tmp_path):
    """A lab may be booted in a test that runs for hours."""
    monkeypatch.setattr(store, "IMAGES", tmp_path)
    monkeypatch.setattr(host, "find_command", refuse)
    before = sorted(path.name for path in Path("/proc/self/fd").iterdir())
    with pytest.raises(LabError):
        host.boot([], "lab", PLAN.host("host1"), "")
    assert sorted(path.name for path in Path("/proc/self/fd").iterdir()) == before
