"""Probe results for working and failing versions of CRIU."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from rosrm_criu.engine.binary import CriuBinary
from rosrm_criu.engine.compatibility import FACTS
from rosrm_criu.engine.probe import criu_support, probe
from tests.programs import require
from tests.waiting import wait_until


def test_one_that_works(criu):
    able = probe(criu)
    assert (able.works, able.reason) == (True, "")
    assert able.facts.keys() == FACTS.keys()
    assert able.facts["version"] == criu.version


def test_as_a_program_it_says_so_in_one_line(criu):
    done = subprocess.run(
        [sys.executable, "-m", "rosrm_criu.engine.probe"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.count("\n") == 1
    assert json.loads(done.stdout).keys() == {"works", "reason", "facts"}
    assert json.loads(done.stdout)["works"] is True


@pytest.mark.parametrize(
    ("suite", "version"), [("bookworm", "3.17"), ("trixie", "4.1")], ids=["3.17", "4.1"]
)
@pytest.mark.slow  # the packages are downloaded once
@pytest.mark.timeout(600)
def test_a_criu_that_is_too_old_is_reported(old, suite, version):
    """The probe rejects Debian 12's CRIU on current kernels, and Debian 13's at the socket."""
    found = old(suite)
    assert found.version.startswith(version)
    able = probe(found)
    if able.works:
        pytest.skip(f"CRIU {found.version} works on this kernel")
    assert able.reason.startswith(
        f"CRIU {found.version} is too old, 4.2 is needed: `scripts/install_criu"
    )
    assert "could not dump: " in able.reason
    assert able.facts["version"] == found.version


def test_a_missing_criu_names_the_places_searched(tmp_path, monkeypatch):
    monkeypatch.delenv("ROSRM_CRIU", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("rosrm_criu.engine.binary._PLACES", str(tmp_path))
    able = criu_support(tmp_path)
    assert (able.works, able.facts) == (False, {})
    assert able.reason == (
        f"there is no CRIU here (looked for: ROSRM_CRIU (not set), {tmp_path}/bin/criu, `criu` in "
        "PATH). `scripts/install_criu.sh` of rosrm's repository installs one in a folder"
    )


def test_a_user_without_rights_reads_what_gives_them(criu, as_nobody, public):
    program = reachable(criu, public)
    done = as_nobody("-m", "rosrm_criu.engine.probe", home=public, ROSRM_CRIU=program)
    able = json.loads(done.stdout)
    assert able["works"] is False
    assert able["reason"].startswith(f"CRIU {criu.version} has no right to dump and restore")
    assert "`sudo setcap cap_checkpoint_restore,cap_setpcap" in able["reason"]
    assert f"+eip {program}`" in able["reason"]
    assert left_in(public, program) == []


def test_what_the_user_reads_gives_the_rights(criu, as_nobody, public):
    program = reachable(criu, public)
    asked = json.loads(
        as_nobody("-m", "rosrm_criu.engine.probe", home=public, ROSRM_CRIU=program).stdout
    )
    command = asked["reason"].split("`")[1].removeprefix("sudo ").split()
    require(command[0])
    if subprocess.run(command, check=False).returncode != 0:
        pytest.skip("no capabilities on this file system")
    done = as_nobody("-m", "rosrm_criu.engine.probe", home=public, ROSRM_CRIU=program)
    able = json.loads(done.stdout)
    assert (able["works"], able["reason"]) == (True, "")
    assert (able["facts"]["uid"], able["facts"]["all_users"]) == ("65534", "no")
    assert left_in(public, program) == []


#: What Docker leaves to root by default.
DOCKER = (
    "chown,dac_override,fowner,fsetid,kill,setgid,setuid,setpcap,net_bind_service,net_raw,"
    "sys_chroot,mknod,audit_write,setfcap"
)


@pytest.mark.parametrize("added", ["", ",checkpoint_restore"], ids=["default", "added"])
def test_root_of_a_container_reads_which_capability_is_missing(criu, added):
    if os.geteuid() != 0:
        pytest.skip("only root has capabilities to give away")
    bounds = f"-all,{DOCKER}{added}".replace(",", ",+")
    contained = ["setpriv", f"--bounding-set={bounds}", "--inh-caps=-all"]
    if subprocess.run([*contained, "true"], check=False).returncode != 0:
        pytest.skip("not all rights to give away")
    done = subprocess.run(
        [*contained, sys.executable, "-m", "rosrm_criu.engine.probe"],
        capture_output=True,
        text=True,
        check=True,
    )
    able = json.loads(done.stdout)
    assert able["works"] is bool(added), able["reason"]
    assert ("(`--cap-add CHECKPOINT_RESTORE`)" in able["reason"]) is not bool(added)


@pytest.mark.parametrize("moment", ["folder", "dump.log", "restore.log"])
def test_a_killed_probe_leaves_nothing_behind(criu, tmp_path, moment):
    """A probe killed after the folder's creation, in the dump or in the restore leaves nothing."""
    asking = subprocess.Popen(
        [sys.executable, "-m", "rosrm_criu.engine.probe"],
        env={**os.environ, "TMPDIR": str(tmp_path)},
        stdout=subprocess.DEVNULL,
    )
    try:
        pattern = "rosrm-criu-*" if moment == "folder" else f"rosrm-criu-*/{moment}"
        until = time.monotonic() + 60
        while not any(tmp_path.glob(pattern)):  # without a pause, because the moment is short
            assert asking.poll() is None, f"it ended before there was a {moment}"
            assert time.monotonic() < until, f"no {moment} within 60 s"
    finally:
        asking.kill()
        asking.wait()
    assert_all_gone(tmp_path)


def test_one_that_hangs_is_given_up_in_time_and_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    hanging = tmp_path / "criu"
    hanging.write_text("#!/bin/sh\nexec sleep 1000\n")
    hanging.chmod(0o755)
    able = probe(CriuBinary((str(hanging),), "4.2"), timeout=3.0)
    assert able.works is False
    assert able.reason.startswith("CRIU 4.2 could not dump: it was not done after ")
    hanging.unlink()
    assert_all_gone(tmp_path)


def test_one_that_only_claims_to_have_restored_does_not_work(tmp_path):
    """A CRIU that only claims success fails; `criu check` and an exit code would accept it."""
    lying = tmp_path / "criu"
    lying.write_text('#!/bin/sh\nif [ "$1" = dump ]; then kill -9 "$3"; fi\n')
    lying.chmod(0o755)
    able = probe(CriuBinary((str(lying),), "4.2"), timeout=3.0)
    assert able.reason == "a child that was restored does not answer over UDP on loopback"


def reachable(criu: CriuBinary, public: Path) -> Path:
    """Copy the program into a folder that every user can read."""
    copy = Path(shutil.copy(os.path.realpath(criu.command[0]), public / "criu"))
    copy.chmod(0o755)
    return copy


def left_in(folder: Path, *expected: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if path not in expected]


def assert_all_gone(folder: Path) -> None:
    """Check that no file is in the folder, and that no process of it is left."""
    lifetime = 15.0  # less than that of the child
    wait_until(lambda: not (left_in(folder) or processes_of(folder)), "an empty folder", lifetime,
               seen=lambda: (left_in(folder), processes_of(folder)))  # fmt: skip


def processes_of(folder: Path) -> list[str]:
    found = []
    for process in psutil.process_iter():
        try:
            if process.pid != os.getpid() and process.environ().get("TMPDIR") == str(folder):
                found.append(f"{process.pid} {' '.join(process.cmdline())[:60]}")
        except psutil.Error:
            continue
    return found
