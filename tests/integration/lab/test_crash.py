"""Kills, signals and errors at each step of a lab: nothing stays on the machine."""

from __future__ import annotations

import errno
import importlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from rosrm.errors import LabError
from rosrm_lab import MIB, Lab, all_labs, disks, store, uniform
from tests.integration.lab.conftest import leaves_nothing, remains
from tests.waiting import PATIENCE, wait_until

ROSRM = Path(sys.executable).parent / "rosrm"
SIZES = ["-n", "2", "--memory", "64MiB", "--cpu", "0.5", "--disk", "16MiB"]

#: Creates a lab, and kills itself before or after the n-th call of a given function.
KILLED_AT = """
import importlib, os, signal, sys
from rosrm_lab import MIB, Lab, uniform
lab, module, function, moment, count = sys.argv[1:]
place = importlib.import_module(module)
real, left = getattr(place, function), [int(count)]
def deadly(*words, **more):
    left[0] -= 1
    if left[0] == 0 and moment == 'before': os.kill(os.getpid(), signal.SIGKILL)
    result = real(*words, **more)
    if left[0] == 0: os.kill(os.getpid(), signal.SIGKILL)
    return result
setattr(place, function, deadly)
Lab(lab, uniform(2, memory=64 * MIB, cpu=0.5, disk=16 * MIB)).up()
"""
STEPS = [
    ("rosrm_lab.store", "write", "before", 1),
    ("rosrm_lab.store", "write", "after", 1),
    ("rosrm_lab.network", "make_switch", "after", 1),
    ("rosrm_lab.groups", "_make_group", "after", 1),
    ("rosrm_lab.groups", "make", "after", 2),
    ("rosrm_lab.disks", "make", "after", 1),
    ("rosrm_lab.network", "plug_in", "before", 2),
    ("rosrm_lab.network", "plug_in", "after", 1),
    ("rosrm_lab.host", "_until_ready", "before", 1),  # the host is booting
    ("rosrm_lab.host", "_until_ready", "after", 1),
    ("rosrm_lab.host", "_last_words", "after", 2),
    ("rosrm_lab.store", "write", "before", 2),
    ("rosrm_lab.store", "write", "after", 2),  # complete, but `up` has not returned
]


def killed_up(name: str, module: str, function: str, moment: str, count: int) -> None:
    """Run an `up` that is killed at a call of this function."""
    command = [sys.executable, "-c", KILLED_AT, name, module, function, moment, str(count)]
    killed = subprocess.run(command, check=False, timeout=PATIENCE * 2)
    assert killed.returncode == -signal.SIGKILL


@pytest.mark.parametrize(("module", "function", "moment", "count"), STEPS)
def test_a_killed_up_is_removed_wholly(name, module, function, moment, count):
    """Both `down` and the next `up` remove what a `lab up` killed at any step left."""
    with leaves_nothing(name):
        killed_up(name, module, function, moment, count)
        Lab(name).down()


def test_a_second_up_removes_what_a_killed_one_left(name):
    """The second `up` also creates its own lab."""
    killed_up(name, "rosrm_lab.host", "_last_words", "after", 1)
    with pytest.raises(LabError, match="is incomplete: `rosrm lab up` makes it again"):
        Lab(name).status()
    assert name in {one.name for one in all_labs()}
    lab = Lab(name, uniform(1, disk=16 * MIB))
    lab.up()
    assert [row.name for row in lab.status()] == ["host1"]
    assert lab.exec("host1", ["hostname"]).stdout == "host1\n"


def test_a_lab_whose_owner_was_killed_was_left_behind(name):
    """The next lab of the same name replaces a complete one whose owner was killed."""
    code = (
        "import os, signal, sys\nfrom rosrm_lab import Lab, MIB, uniform\n"
        "with Lab(sys.argv[1], uniform(1, disk=16 * MIB)) as lab:\n"
        "    lab.popen('host1', ['setsid', 'sleep', '1000'])\n"
        "    os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code, name], check=False, timeout=PATIENCE)
    assert Lab(name).is_up("host1")
    with Lab(name, uniform(1, disk=16 * MIB)) as lab:
        assert lab.status()[0].processes == 0


def test_a_lab_that_fails_while_it_is_made_leaves_nothing(name, monkeypatch):
    """A failure to create the second disk removes the first host, too."""
    real = disks.make

    def fails(image, host):
        if host.name == "host2":
            raise LabError("no room")
        real(image, host)

    monkeypatch.setattr(disks, "make", fails)
    with leaves_nothing(name), pytest.raises(LabError, match="no room"):
        Lab(name, uniform(2, disk=16 * MIB)).up()


class Stopped(Exception):
    """An exception raised by a signal handler, as in programs that end cleanly."""


@pytest.fixture
def stopped_at(monkeypatch):
    """Yield a function that arms a raising signal at the first call of another function."""

    def stop(*_):
        raise Stopped

    def arm(module, function, moment):
        place = importlib.import_module(module)
        real, calls = getattr(place, function), []

        def deadly(*words, **more):
            calls.append(function)
            if len(calls) == 1 and moment == "before":
                os.kill(os.getpid(), signal.SIGUSR1)
            result = real(*words, **more)
            if len(calls) == 1:
                os.kill(os.getpid(), signal.SIGUSR1)
            return result

        monkeypatch.setattr(place, function, deadly)

    kept = signal.signal(signal.SIGUSR1, stop)
    yield arm
    signal.signal(signal.SIGUSR1, kept)


REMOVAL = [
    ("rosrm_lab.groups", "kill", "before"),
    ("rosrm_lab.groups", "kill", "after"),
    ("rosrm_lab.network", "remove", "before"),
    ("rosrm_lab.network", "remove", "after"),
    ("rosrm_lab.store", "forget", "before"),
]


@pytest.mark.parametrize(("module", "function", "moment"), REMOVAL)
def test_a_signal_during_the_removal_leaves_nothing(name, stopped_at, module, function, moment):
    """The signal's exception is raised after the removal of the lab."""
    with leaves_nothing(name), pytest.raises(Stopped), Lab(name, uniform(1, disk=16 * MIB)):
        stopped_at(module, function, moment)


def test_a_signal_while_a_failed_attempt_is_removed_leaves_nothing(name, stopped_at, monkeypatch):
    """A signal arrives during the removal of a lab that could not be created."""
    before = remains(name)

    def fails(image, host):
        stopped_at("rosrm_lab.groups", "kill", "before")
        raise LabError("no room")

    monkeypatch.setattr(disks, "make", fails)
    with pytest.raises(Stopped):
        Lab(name, uniform(1, disk=16 * MIB)).up()
    assert remains(name) == before


def test_what_a_killed_lab_holds_does_not_hinder_the_next(name, monkeypatch):
    """The old lab is removed before the memory check, even if that check fails afterwards."""
    before = remains(name)
    killed_up(name, "rosrm_lab.host", "_last_words", "after", 1)
    assert remains(name) != before
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=MIB))
    with pytest.raises(LabError, match="1 MiB are available on this machine"):
        Lab(name, uniform(1, memory=64 * MIB, disk=16 * MIB)).up()
    assert remains(name) == before


def test_a_second_up_of_a_lab_is_refused(lab, monkeypatch):
    """The error names the existing lab even if memory for a second one is missing."""
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=MIB))
    with pytest.raises(LabError, match="is up already"):
        Lab(lab.name, uniform(1, memory=64 * MIB, disk=16 * MIB)).up()
    assert lab.is_up("host1")


@pytest.mark.parametrize("count", [1, 2])
def test_a_file_that_cannot_be_written_is_one_clear_error(name, monkeypatch, count):
    """The write fails at the beginning or at the completion of the lab; nothing is left."""
    real, calls = store.write, []

    def full(record):
        calls.append(record)
        if len(calls) == count:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/run/rosrm-lab")
        real(record)

    monkeypatch.setattr(store, "write", full)
    with (
        leaves_nothing(name),
        pytest.raises(LabError, match=r"this machine refuses .*No space left on device"),
    ):
        Lab(name, uniform(1, disk=16 * MIB)).up()


def test_a_kernel_without_bridges_is_one_clear_error(name, monkeypatch):
    """The test requests an interface kind that no kernel has; nothing is left."""
    from rosrm_lab import network

    class Without(network.IPRoute):
        def link(self, command, **what):
            if what.get("kind") == "bridge":
                what["kind"] = "no-such-kind"
            return self.__getattr__("link")(command, **what)

    monkeypatch.setattr(network, "IPRoute", Without)
    with (
        leaves_nothing(name),
        pytest.raises(LabError, match=r"the bridge .* cannot be made: Operation not supported"),
    ):
        Lab(name, uniform(1, disk=16 * MIB)).up()


def test_a_host_that_cannot_boot_says_why(name, monkeypatch):
    """The error contains the failed command, and nothing is left."""
    monkeypatch.setattr(disks, "make", lambda image, host: (
        image.parent.mkdir(parents=True, exist_ok=True), image.write_bytes(bytes(MIB))
    ))  # fmt: skip
    with (
        leaves_nothing(name),
        pytest.raises(LabError, match=r"host1 .* could not be booted: mount -o loop"),
    ):
        Lab(name, uniform(1, disk=16 * MIB)).up()


@pytest.mark.parametrize("damage", ["", "{", "not json"])
def test_down_needs_no_state_file(name, damage):
    """A damaged state file does not prevent the removal."""
    before = remains(name)
    lab = Lab(name, uniform(1, disk=16 * MIB))
    lab.up()
    process = lab.popen("host1", ["sleep", "1000"])  # may be at any stage of its start by now
    (store.RUN / name / "lab.json").write_text(damage)
    assert lab.down()
    assert remains(name) == before
    assert process.wait(PATIENCE) != 0  # killed, or the host was gone when it started
    assert not lab.down()


def test_down_ends_what_ignores_signals_and_daemons(lab):
    """`down` also ends processes that run outside the quota."""
    stubborn = "trap '' TERM INT HUP; (setsid sleep 1000 &) ; sleep 1000"
    process = lab.popen("host1", ["sh", "-c", stubborn], limited=False)
    wait_until(lambda: len(lab.pids("host1")) >= 3, "the shell and two sleepers")
    pids = lab.pids("host1")
    assert lab.down()
    # The shell may see the end of its sleeper before its own.
    assert process.wait(PATIENCE) in (-signal.SIGKILL, 128 + signal.SIGKILL)
    assert not [pid for pid in pids if Path(f"/proc/{pid}/status").exists() and _alive(pid)]


def _alive(pid):
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_ctrl_c_during_up_leaves_nothing(name):
    """Ctrl-C at any moment of `up` removes everything."""
    before = remains(name)
    for wait in (0.6, 0.9, 1.2):
        process = subprocess.Popen(
            [ROSRM, "lab", "up", "--lab", name, *SIZES], stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        time.sleep(wait)  # any moment of `up` is good
        os.killpg(process.pid, signal.SIGINT)
        said, _ = process.communicate(timeout=PATIENCE)
        assert b"Traceback" not in said
        if process.returncode == 0:  # `up` was complete already
            Lab(name).down()
        assert remains(name) == before, (process.returncode, said)


def test_the_command_line_from_up_to_down(name):
    """The commands that a user types work, with their output and exit codes."""

    def rosrm(*words):
        done = subprocess.run(
            [ROSRM, "lab", *words], capture_output=True, text=True, timeout=PATIENCE * 2,
            env={**os.environ, "ROSRM_LAB": name}, check=False,
        )  # fmt: skip
        return done.returncode, done.stdout, done.stderr

    code, out, err = rosrm("up", *SIZES, "--host", "desk:memory=none,cpu=none")
    assert (code, err) == (0, "")
    assert out.startswith(f"lab '{name}' is up: host1 10.")
    assert rosrm("exec", "host1", "sh", "-c", "echo here; exit 7")[:2] == (7, "here\n")
    assert rosrm("exec", "--env", "X=1", "host1", "--", "printenv", "X")[:2] == (0, "1\n")
    assert rosrm("cut", "host1", "--direction", "in")[1] == "host1: in: cut\n"
    assert rosrm("loss", "host1", "1%")[1] == "host1: in: cut, loss 1 %; out: loss 1 %\n"
    assert rosrm("heal", "host1")[1] == "host1: its network has no fault\n"
    assert rosrm("kill", "host2")[0] == 0
    rows = json.loads(rosrm("status", "--lab", name, "--json")[1])
    assert [(row["name"], row["state"]) for row in rows] == [
        ("host1", "up"), ("host2", "off"), ("desk", "up"),
    ]  # fmt: skip
    code, _, err = rosrm("exec", "host2", "true")
    assert code == 1
    assert "host2 of lab" in err
    assert "boot host2" in err
    assert rosrm("boot", "host2")[:2] == (0, "host2 is up\n")
    assert rosrm("exec", "host9", "true")[0] == 2
    assert rosrm("up", *SIZES)[0] == 1
    assert rosrm("down")[:2] == (0, f"removed: {name}\n")
    assert rosrm("down")[:2] == (0, f"no lab '{name}': nothing to remove\n")
    assert rosrm("exec", "host1", "true")[0] == 1


def test_an_unprivileged_user_learns_what_is_missing(name):
    """The error shows the alternative without root; no traceback, nothing created."""
    nobody = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "--inh-caps=-all"]
    done = subprocess.run(
        [*nobody, ROSRM, "lab", "up", "--lab", name, *SIZES], capture_output=True, text=True,
        timeout=PATIENCE, check=False,
    )  # fmt: skip
    if "Permission denied" in done.stderr or "No module" in done.stderr:
        pytest.skip("the environment is not readable for another user")
    assert done.returncode == 1, done.stderr
    assert "CAP_SYS_ADMIN for namespaces, mounts and control groups" in done.stderr
    assert "budget: {memory: 64MiB, cpu: 0.5, disk: 16MiB}" in done.stderr
    assert "Traceback" not in done.stderr
