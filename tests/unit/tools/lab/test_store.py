"""Stored records of labs, and their locks."""

from __future__ import annotations

import os
import subprocess
import sys
from ipaddress import IPv4Network

import pytest

from rosrm.errors import LabError
from rosrm_lab import store
from rosrm_lab.plan import LabPlan, uniform
from rosrm_lab.store import Birth, LabRecord
from rosrm_lab.wires import Link


@pytest.fixture(autouse=True)
def folders(monkeypatch, tmp_path):
    """Use folders without the machine's own labs."""
    monkeypatch.setattr(store, "RUN", tmp_path / "run" / "rosrm-lab")
    monkeypatch.setattr(store, "IMAGES", tmp_path / "lib" / "rosrm-lab")
    (tmp_path / "run").mkdir()
    (tmp_path / "lib").mkdir()


def record(name="lab"):
    plan = LabPlan(name, tuple(uniform(2)), IPv4Network("10.9.8.0/24"))
    links = {"host1": Link().changed("in", cut=True), "host2": Link()}
    return LabRecord(plan, True, "boot", Birth(1, 2), {"host1": Birth(3, 4)}, links)


def test_a_record_is_read_as_it_was_written():
    """Every field is restored."""
    store.write(record())
    assert store.read("lab") == record()


def test_the_files_of_a_lab_are_for_its_user_alone():
    """The disks of the hosts hold state directories."""
    store.write(record())
    store.make_private_folder(store.image("lab", "host1").parent)
    folders = (store.RUN, store.RUN / "lab", store.IMAGES, store.IMAGES / "lab")
    assert {folder.stat().st_mode & 0o777 for folder in folders} == {0o700}
    assert (store.RUN / "lab" / "lab.json").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("damage", ["", "{", "[]", '{"version": 2}', '{"version": 1}', "null"])
def test_a_damaged_record_is_as_good_as_none(damage):
    """The parts of a lab can be removed without its record."""
    store.write(record())
    (store.RUN / "lab" / "lab.json").write_text(damage)
    assert store.read("lab") is None
    assert store.labs() == {"lab"}


def test_what_is_forgotten_leaves_no_folder():
    """The folder above is removed with the last lab."""
    store.write(record("a"))
    store.write(record("b"))
    store.image("a", "host1").parent.mkdir(parents=True)
    store.image("a", "host1").write_text("disk")
    store.forget("a")
    assert store.labs() == {"b"}
    store.forget("b")
    assert not store.RUN.exists()
    assert not store.IMAGES.exists()


def test_a_process_is_not_taken_for_a_later_one():
    """The pid alone does not identify a process."""
    mine = Birth.of(os.getpid())
    assert mine.alive
    assert not Birth(mine.pid, mine.started - 1).alive


def test_a_lock_is_held_by_one():
    """The second process waits and names the holder."""
    at_work = pytest.raises(LabError, match="another command is at work on lab 'x'")
    with store.lock("x"), at_work, store.lock("x", timeout=0.1):
        pytest.fail("held twice")
    with store.lock("x"), store.lock("y"):
        pass


def test_a_lock_ends_with_who_held_it():
    """A killed command blocks no other."""
    code = (
        "import os, signal\nfrom rosrm_lab import store\n"
        "with store.lock('test-killed'): os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code], check=False, timeout=60)
    with store.lock("test-killed", timeout=0.0):
        pass
