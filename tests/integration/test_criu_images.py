"""Dump of real processes into images, and their restore below the shim."""

from __future__ import annotations

import errno
import json
import os
import signal
import socket
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from rosrm.core.supervisor.events import StopOrdered
from rosrm.errors import CriuError
from rosrm.model.values import RestartPolicy
from rosrm.supervisor.client_values import key_of
from rosrm_criu.engine import (
    copied_pages,
    dump,
    image,
    memory_copy,
    process_tree,
    restore,
    restore_result,
)
from rosrm_criu.engine.copied_pages import CopiedPages
from rosrm_criu.engine.image import MappedFile
from tests.criu_kit import TIMEOUT, eventually
from tests.integration.supervisor.conftest import Host

pytestmark = pytest.mark.timeout(240)

#: Writes one number after the other; ends with 7 at SIGTERM, says so at SIGUSR1.
COUNTER = """
import os, signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))
signal.signal(signal.SIGUSR1, lambda *_: os.write(1, b"usr1\\n"))
count = 0
while True:
    count += 1
    print(count, flush=True)
    time.sleep(0.01)
"""


@pytest.fixture
def counter(theatre):
    """Return a counter that counts."""
    actor = theatre.start(COUNTER)
    actor.counts()
    return actor


#: Holds 8 MB, changes 200 bytes of it at SIGUSR1, and prints the checksum at SIGUSR2.
CHANGER = """
import os, signal, zlib
held, step = bytearray(range(256)) * (8_000_000 // 256), 40_000
def change(*_):
    for at in range(0, len(held), step):
        held[at] ^= 0xFF
    os.write(1, b"changed\\n")
signal.signal(signal.SIGUSR1, change)
signal.signal(signal.SIGUSR2, lambda *_: os.write(1, b"%d\\n" % zlib.crc32(held)))
print("ready", flush=True)
while True:
    signal.pause()
"""


@pytest.fixture
def changer(theatre):
    """Return a process that changes its memory and prints its checksum."""
    actor = theatre.start(CHANGER)
    actor.says("ready")
    return actor


def print_checksum(changer, pid):
    """Let the process, original or restored, print the checksum of its memory."""
    os.kill(pid, signal.SIGUSR2)
    eventually(changer.numbers, "a checksum")


def check_restored_memory(theatre, changer, directory):
    """Restore the process, whose checksum is printed, and compare both checksums."""
    restored = theatre.restore(directory)
    print_checksum(restored, restored.outcome.pid)
    assert restored.numbers() == changer.numbers()


# --- what continues -----------------------------------------------------------------------------


@pytest.mark.parametrize("again", [False, True])
@pytest.mark.parametrize("changes", [0, 1])
def test_a_process_is_restored_from_a_copy_and_its_later_changes(theatre, changer, again, changes):
    """CRIU reads pages that were equal in the dump from the copies, which were made before.

    What has changed since the first copy is copied again, or left to the dump. The second change
    is back to the first content.
    """
    copy = memory_copy.copy([changer.pid], theatre.folder / "copy", lambda: None)
    os.kill(changer.pid, signal.SIGUSR1)
    eventually(lambda: changer.lines().count("changed\n") == 1, "a change")
    if again:
        copy = memory_copy.copy_changes(copy, [changer.pid], lambda: None)
        assert (copy.directory / "changes").exists()
    if changes:
        os.kill(changer.pid, signal.SIGUSR1)
        eventually(lambda: changer.lines().count("changed\n") == 2, "another change")
    print_checksum(changer, changer.pid)
    directory = theatre.dump(changer, copy=copy)
    changed = image.file_sizes(directory)
    assert sum(size for name, size in changed.items() if "/pages-" in name) < 3_000_000
    copied_pages.move_into_parent(directory, copy.directory)
    check_restored_memory(theatre, changer, directory)


def test_a_process_is_dumped_whole_if_its_pages_cannot_be_compared(theatre, changer, monkeypatch):
    """CRIU's first dump fails in the middle, and the second one has the whole memory."""
    copy = memory_copy.copy([changer.pid], theatre.folder / "copy", lambda: None)
    print_checksum(changer, changer.pid)
    compare, calls = CopiedPages.equal, []

    def fail(*arguments):
        calls.append(arguments)
        if len(calls) > 30:
            raise OSError(errno.EIO, "the copy cannot be read")
        return compare(*arguments)

    monkeypatch.setattr(CopiedPages, "equal", fail)
    directory = theatre.dump(changer, copy=copy)
    assert len(calls) == 31
    assert theatre.manifest.sizes == image.file_sizes(directory)
    assert not (directory / image.PARENT).exists()
    check_restored_memory(theatre, changer, directory)


def test_a_restored_process_continues_and_logs_into_the_new_file(theatre, counter):
    """No number is missing or written twice; the old log grows no more."""
    directory = theatre.dump(counter)
    before = counter.numbers()
    restored = theatre.restore(directory)
    restored.counts()
    after = restored.numbers()
    assert before + after == list(range(1, after[-1] + 1))
    assert counter.numbers() == before


def test_five_hops_in_a_row(theatre, counter):
    """A restored process is dumped and restored again, and keeps the pid that it sees itself."""
    actor, numbers, inner = counter, [], set()
    for hop in range(5):
        directory = theatre.dump(actor, f"hop{hop}")
        numbers += actor.numbers()
        actor = theatre.restore(directory, remove=True)
        inner.add(actor.outcome.inner_pid)
        actor.counts()
    numbers += actor.numbers()
    assert numbers == list(range(1, numbers[-1] + 1))
    assert inner == {counter.pid}


def test_a_udp_socket_is_the_same_after_the_restore(theatre):
    """The process answers at the same address, and continues its count."""
    code = """
import socket
ours, count = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), 0
ours.bind(("127.0.0.1", 0))
print(ours.getsockname()[1], flush=True)
while True:
    _, asker = ours.recvfrom(16)
    count += 1
    ours.sendto(b"%d" % count, asker)
"""
    actor = theatre.start(code)
    eventually(actor.numbers, "its port")
    address = ("127.0.0.1", actor.numbers()[0])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours:
        ours.settimeout(TIMEOUT)
        ours.sendto(b"?", address)
        assert ours.recv(16) == b"1"
        theatre.restore(theatre.dump(actor))
        ours.sendto(b"?", address)
        assert ours.recv(16) == b"2"


def test_a_heap_of_numpy_with_its_threads_is_the_same(theatre):
    """8 MB of random numbers and three threads have the same sum, and the threads run."""
    code = """
import hashlib, threading, time, numpy
heap = numpy.random.default_rng(1).random(1 << 20)
def turn(name):
    while True:
        time.sleep(0.01)
        print(name, hashlib.sha256(heap.tobytes()).hexdigest(), flush=True)
for name in "ab":
    threading.Thread(target=turn, args=name).start()
turn("c")
"""
    actor = theatre.run([sys.executable, "-I", "-c", code])
    eventually(lambda: {line[0] for line in actor.lines()} >= {*"abc"}, "its threads")
    sums = {line.split()[1] for line in actor.lines()}
    restored = theatre.restore(theatre.dump(actor))
    eventually(lambda: {line[0] for line in restored.lines()} == {*"abc"}, "its threads again")
    assert len(sums) == 1
    assert {line.split()[1] for line in restored.lines()} == sums
    assert theatre.manifest.size > 8 << 20


def test_child_and_pipe_are_restored_with_their_parent(theatre):
    """The tree is dumped with its pipes: the child's numbers still come through its parent."""
    code = f"""
import subprocess, sys
child = subprocess.Popen([sys.executable, "-I", "-S", "-c", {COUNTER!r}], stdout=subprocess.PIPE)
for line in child.stdout:
    print(line.decode(), end="", flush=True)
"""
    actor = theatre.start(code)
    actor.counts()
    directory = theatre.dump(actor)
    restored = theatre.restore(directory)
    restored.counts()
    numbers = actor.numbers() + restored.numbers()
    assert numbers == list(range(1, numbers[-1] + 1))


def test_a_file_below_the_working_directory_follows(theatre):
    """The file has its content at the dump, and the process continues at its position."""
    code = f"import sys; sys.stdout = open('count', 'w')\n{COUNTER}"
    actor = theatre.start(code)
    count = theatre.work / "count"
    eventually(lambda: count.exists() and count.read_text().count("\n") > 2, "its file")
    directory = theatre.dump(actor)
    written = count.read_text()
    count.unlink()  # as on another host
    theatre.restore(directory)
    eventually(lambda: count.exists() and len(count.read_text()) > len(written), "more in it")
    numbers = [int(line) for line in count.read_text().splitlines(True) if line.endswith("\n")]
    assert numbers == list(range(1, numbers[-1] + 1))


def test_a_missing_log_of_its_own_is_created(theatre):
    """A file that is only appended to, such as rcl's in ~/.ros/log, does not follow."""
    own = theatre.folder / "logs/own.log"
    own.parent.mkdir()
    actor = theatre.start(f"import sys; sys.stdout = open({str(own)!r}, 'a')\n{COUNTER}")
    eventually(lambda: own.exists() and own.read_text().count("\n") > 2, "its log")
    directory = theatre.dump(actor)
    own.unlink()
    own.parent.rmdir()
    theatre.restore(directory)
    eventually(lambda: own.exists() and own.read_text().count("\n") > 2, "its log again")


def test_a_process_in_its_supervisors_directory_moves_to_that_of_another_host(theatre):
    """Its path differs there: working directory and files below it follow, hop by hop."""

    def state(number: int) -> dict[str, str]:
        return {"ROSRM_SUPERVISOR": str(theatre.folder / f"host{number}")}

    def shelter(number: int) -> Path:
        return theatre.folder / f"host{number}/work"

    code = f"import os, sys; sys.stdout, there = open('count', 'w'), os.open('.', 0)\n{COUNTER}"
    for number in range(3):
        shelter(number).mkdir(parents=True)
    theatre.work = shelter(0)
    actor = theatre.start(code, environment=state(0))
    for number in range(1, 3):
        before = shelter(number - 1) / "count"
        eventually(lambda: before.exists() and before.read_text().count("\n") > 2, "numbers")  # noqa: B023
        directory = theatre.dump(actor, f"hop{number}")
        before.unlink()
        shelter(number - 1).rmdir()
        actor = theatre.restore(directory, environment=state(number))
        assert working_directory(actor.outcome.pid) == str(shelter(number))
        image.read(directory)  # nothing was changed in the image itself
        size = theatre.manifest.files[0].size
        here = shelter(number) / "count"
        eventually(lambda: here.stat().st_size > size, "more numbers")  # noqa: B023
    numbers = [int(line) for line in here.read_text().splitlines(True) if line.endswith("\n")]
    assert numbers == list(range(1, numbers[-1] + 1))


def working_directory(pid: int) -> str:
    return os.readlink(f"/proc/{pid}/cwd")  # noqa: PTH115 - as /proc says it


def test_files_of_proc_are_not_part_of_the_image(theatre):
    """CRIU itself restores an open file of the process's own folder in /proc."""
    actor = theatre.start(f"import os; own = open(f'/proc/{{os.getpid()}}/stat')\n{COUNTER}")
    actor.counts()
    theatre.restore(theatre.dump(actor)).counts()
    assert theatre.manifest.files == ()


# --- the source -------------------------------------------------------------------------------


def test_it_is_not_stopped_for_the_checksums(theatre, counter, monkeypatch):
    """The checksums of a large image take as long as its dump; the process runs in that time."""
    make = image.file_checksums

    def make_while_it_counts(directory, names):
        counter.counts()
        return make(directory, names)

    monkeypatch.setattr(image, "file_checksums", make_while_it_counts)
    theatre.dump(counter, leave="running")
    assert theatre.manifest.checksums.keys() == theatre.manifest.sizes.keys()
    numbers = counter.numbers()  # read once, because the process still counts
    assert numbers == list(range(1, numbers[-1] + 1))


def test_a_process_that_was_stopped_before_stays_stopped(theatre, counter):
    """A dump does not continue a process that a user has stopped."""
    counter.process.send_signal(signal.SIGSTOP)
    assert process_tree.wait_until_stopped([counter.pid], TIMEOUT)
    theatre.dump(counter, leave="running")
    assert process_tree.is_stopped(counter.pid)


def test_after_any_error_the_source_runs_on(theatre, counter, monkeypatch):
    """This includes a bug of rosrm after CRIU has stopped the process."""
    monkeypatch.setattr(image, "write", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        theatre.dump(counter)
    counter.counts()
    assert not process_tree.is_stopped(counter.pid)


@pytest.mark.parametrize("kind", [socket.SOCK_STREAM, socket.SOCK_DGRAM])
def test_a_unix_socket_to_outside_is_named_and_the_source_runs_on(theatre, kind):
    """CRIU dumps a stream and fails to restore it; a datagram socket it refuses."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, kind)
    with ours, theirs:
        actor = theatre.start(COUNTER, pass_fds=(theirs.fileno(),))
        theirs.close()
        actor.counts()
        with pytest.raises(CriuError, match=f"Unix socket that is connected to pid {os.getpid()}"):
            theatre.dump(actor)
        actor.counts()


def test_a_socket_pair_within_the_process_is_dumped(theatre):
    """An event loop has one to wake itself."""
    code = f"import socket; pair = socket.socketpair()\n{COUNTER}"
    actor = theatre.start(code)
    actor.counts()
    theatre.restore(theatre.dump(actor)).counts()


def test_a_debugger_is_named_and_the_source_runs_on(theatre, counter):
    """Only one process can trace another one; the process is not harmed."""
    code = """
import ctypes, signal, sys
libc = ctypes.CDLL(None, use_errno=True)
libc.ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
SEIZE = 0x4206
print(libc.ptrace(SEIZE, int(sys.argv[1]), None, None), flush=True)
while True:
    signal.pause()
"""
    debugger = theatre.start(code, str(counter.pid))
    eventually(debugger.lines, "an answer of the kernel")
    if debugger.lines() != ["0\n"]:
        pytest.skip("no process may be traced here")
    with pytest.raises(CriuError, match=f"is held by pid {debugger.pid} "):
        theatre.dump(counter)
    debugger.process.kill()
    debugger.process.wait(TIMEOUT)
    counter.counts()


@pytest.mark.skipif(not os.access("/dev/fuse", os.W_OK), reason="/dev/fuse may not be opened")
def test_a_device_is_named_and_the_source_runs_on(theatre):
    """The error explains CRIU's own refusal, and only CRIU's log is left of the image."""
    actor = theatre.start(f"device = open('/dev/fuse', 'rb+', buffering=0)\n{COUNTER}")
    actor.counts()
    with pytest.raises(CriuError, match=r"file descriptor \d+ is the device /dev/fuse"):
        theatre.dump(actor)
    actor.counts()
    assert [path.name for path in (theatre.folder / "image").iterdir()] == ["dump.log"]


def test_an_image_without_disk_space_is_not_begun(theatre, counter, monkeypatch):
    """The file system of the image keeps some space; the process is not touched."""
    monkeypatch.setattr(process_tree, "memory_of", lambda pids: 1 << 60)
    with pytest.raises(CriuError, match=r"no room for the image .* MiB are free"):
        theatre.dump(counter)
    counter.counts()
    assert [*(theatre.folder / "image").iterdir()] == []


# --- below the shim -----------------------------------------------------------------------------


def test_the_exit_code_comes_through_the_shim(theatre, counter):
    """SIGTERM is forwarded, and the shim ends with the exit code of the process."""
    restored = theatre.restore(theatre.dump(counter))
    restored.process.terminate()
    assert restored.process.wait(TIMEOUT) == 7


@pytest.mark.parametrize("option", [[], ["--no-namespace"]])
def test_a_process_that_ends_at_once_was_restored(theatre, option):
    """The exit code of a process with one last instruction arrives."""
    code = "import os, signal; os.kill(os.getpid(), signal.SIGSTOP); os._exit(9)"
    actor = theatre.start(code)
    assert process_tree.wait_until_stopped([actor.pid], TIMEOUT)
    directory = theatre.dump(actor)
    shim = theatre.shim(directory, *option)
    eventually((directory / restore_result.FILE).exists, "the end of the restore")
    os.killpg(shim.pid, signal.SIGCONT)
    assert shim.process.wait(TIMEOUT) == 9
    assert json.loads((directory / restore_result.FILE).read_text())["reason"] == ""


def test_signals_come_through_the_shim(theatre, counter):
    """The restored process handles its signals; the shim ends by the signal that kills it."""
    restored = theatre.restore(theatre.dump(counter))
    os.killpg(restored.pid, signal.SIGUSR1)
    restored.says("usr1")
    assert restored.lines().count("usr1\n") == 1
    os.killpg(restored.pid, signal.SIGUSR2)
    assert restored.process.wait(TIMEOUT) == -signal.SIGUSR2


@pytest.mark.parametrize("ends", ["the group of the shim", "the shim", "the process"])
def test_with_the_shim_or_the_process_all_of_it_ends(theatre, ends):
    """Even a daemon that has left group and session ends, within milliseconds on an idle machine.

    If the process itself ends, all others have ended before the shim does.
    """
    code = f"""
import os, signal
def become_two(*_):
    if os.fork() == 0:
        os.setsid()
        if os.fork():
            os._exit(0)
        os.write(1, b"daemon\\n")
signal.signal(signal.SIGHUP, become_two)
{COUNTER}"""
    actor = theatre.start(code)
    actor.counts()
    restored = theatre.restore(theatre.dump(actor))
    os.killpg(restored.pid, signal.SIGHUP)
    restored.says("daemon")
    namespace = pid_namespace(restored.outcome.pid)
    assert len(living_in(namespace)) == 3  # the init, the process, the daemon
    if ends == "the process":
        restored.process.terminate()
        assert restored.process.wait(TIMEOUT) == 7
        assert living_in(namespace) == []
        return
    killed = time.monotonic()
    if ends == "the shim":
        restored.process.kill()
    else:
        os.killpg(restored.pid, signal.SIGKILL)
    eventually(lambda: not living_in(namespace), "the end of all in the namespace")
    assert time.monotonic() - killed < 10.0
    assert restored.process.wait(TIMEOUT) == -signal.SIGKILL


def pid_namespace(pid: int) -> str:
    return os.readlink(f"/proc/{pid}/ns/pid")  # noqa: PTH115 - it leads nowhere


def living_in(namespace: str) -> list[int]:
    """Return the processes of a pid namespace, except zombies."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and pid_namespace(int(entry.name)) == namespace:
                found.append(int(entry.name))
        except OSError:  # it has ended
            continue
    return [pid for pid in found if process_tree.is_alive(pid)]


def test_marks_of_the_former_instance_are_removed(theatre):
    """A supervisor that looks for leftovers of the old instance does not find the restored one."""
    marks = {"ROSRM_INSTANCE": "actor#1", "ROSRM_SUPERVISOR": "/somewhere", "MORE": "kept"}
    actor = theatre.start(COUNTER, environment=marks)
    actor.counts()
    restored = theatre.restore(theatre.dump(actor))
    shown = Path(f"/proc/{restored.outcome.pid}/environ").read_bytes().split(b"\0")
    assert {b"ROSRM_INSTANCE=", b"ROSRM_SUPERVISOR=", b"MORE=kept"} <= {*shown}


def test_the_image_is_private_and_removed_on_request(theatre, counter):
    """No other user can read the memory; only the result of the restore is left."""
    directory = theatre.dump(counter)
    modes = {path.stat().st_mode & 0o077 for path in [directory, *directory.rglob("*")]}
    assert modes == {0}
    restored = theatre.restore(directory, remove=True)
    eventually(
        lambda: [path.name for path in directory.iterdir()] == [restore_result.FILE], "a clean end"
    )
    restored.process.terminate()
    restored.process.wait(TIMEOUT)
    assert [path.name for path in directory.iterdir()] == [restore_result.FILE]


@pytest.mark.parametrize("victim", ["the process", "its shim"])
def test_the_result_of_a_restore_outlives_the_process(theatre, counter, victim):
    """The result of a restore survives any early end of the process; its memory is removed."""
    directory = theatre.dump(counter)
    restored = theatre.restore(directory, remove=True)
    outcome = restored.outcome
    eventually(
        lambda: [path.name for path in directory.iterdir()] == [restore_result.FILE], "its removal"
    )
    pid = restored.pid if victim == "its shim" else restored.outcome.pid
    os.kill(pid, signal.SIGKILL)
    assert restored.process.wait(TIMEOUT) == -signal.SIGKILL
    assert [path.name for path in directory.iterdir()] == [restore_result.FILE]
    assert restore_result.wait(directory, timeout=TIMEOUT, ended=lambda: True) == outcome


@pytest.fixture
def host(tmp_path):
    """Yield a supervisor's state directory."""
    host = Host(tmp_path / "host")
    yield host
    host.clean_up()


def restored_below(host, theatre, directory, *, order=None, **options):
    """Restore an image below a supervisor; return its client, and the running instance."""
    client = host.connect()
    command = theatre.shim_command(directory, **options)
    client.start([host.order("actor", *command, number=2, **(order or {}))])
    running = host.running(client, "actor", number=2)
    eventually((directory / restore_result.FILE).exists, "the end of the restore")
    return client, running


def test_a_supervisor_manages_a_restored_process(theatre, counter, host):
    """The supervisor starts a shim like any process: it stops it, and sees its end."""
    client, running = restored_below(host, theatre, theatre.dump(counter))
    assert process_tree.root_of(running.pid) != running.pid
    client.send(StopOrdered(key_of(running.instance)))
    ended = host.ended(client, "actor", number=2)
    assert (ended.exit_code, ended.exit_signal) == (0, signal.SIGINT)


def test_the_next_supervisor_adopts_it(theatre, counter, host):
    """The process runs on while its supervisor is killed, and is stopped like any other."""
    client, before = restored_below(host, theatre, theatre.dump(counter))
    log = host.log("actor", 2)
    host.kill_supervisor(client)
    client = host.connect()
    [after] = client.instances
    seen = log.read_text()
    eventually(lambda: len(log.read_text()) > len(seen), "more numbers")
    client.send(StopOrdered(key_of(after.instance)))
    host.ended(client, "actor", number=2)
    assert (after.state, after.pid) == (before.state, before.pid)
    assert not process_tree.is_alive(before.pid)


def test_the_supervisor_kills_a_process_that_does_not_stop(theatre, host):
    """The stop policy ends in a SIGKILL of the shim's group, which leaves no process."""
    ignoring = "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
    code = COUNTER.replace("count = 0", f"{ignoring}count = 0").replace("sys.exit(7)", "None")
    actor = theatre.start(code)
    actor.counts()
    client, running = restored_below(host, theatre, theatre.dump(actor))
    namespace = pid_namespace(process_tree.root_of(running.pid))
    client.send(StopOrdered(key_of(running.instance)))
    ended = host.ended(client, "actor", number=2)
    assert ended.exit_signal == signal.SIGKILL
    eventually(lambda: not living_in(namespace), "the end of all in the namespace")


def test_the_restart_policy_holds_for_a_restored_process(theatre, counter, host):
    """The restart policy applies to a restored process: it counts from one, as after any crash."""
    then = [sys.executable, "-I", "-S", "-c", COUNTER, "--", "an argument"]
    restart = RestartPolicy("on-failure", delay=0.01)
    client, running = restored_below(
        host, theatre, theatre.dump(counter), order={"restart": restart}, remove=True, then=then
    )
    log = host.log("actor", 2)
    assert "\n1\n" not in log.read_text()
    os.kill(process_tree.root_of(running.pid), signal.SIGKILL)
    eventually(lambda: "\n1\n2\n" in log.read_text(), "numbers from the first on")
    client.send(StopOrdered(key_of(running.instance)))
    host.ended(client, "actor", number=2)


# --- without a namespace ------------------------------------------------------------------------


def test_without_a_namespace_it_is_restored_too(theatre, counter):
    """If no namespace may be entered, the pid is the same, and signals and exit code arrive."""
    directory = theatre.dump(counter)
    restored = theatre.restore(directory, "--no-namespace")
    restored.counts()
    assert not restored.outcome.namespace
    assert restored.outcome.pid == restored.outcome.inner_pid == counter.pid
    again = theatre.restore(theatre.dump(restored, "again"), "--no-namespace")
    again.counts()
    again.process.terminate()
    assert again.process.wait(TIMEOUT) == 7


def test_without_a_namespace_a_guard_ends_it_with_its_shim(theatre, counter):
    """A SIGKILL of the shim's group reaches the restored process too."""
    restored = theatre.restore(theatre.dump(counter), "--no-namespace")
    os.killpg(restored.pid, signal.SIGKILL)
    eventually(
        lambda: not process_tree.is_alive(restored.outcome.pid), "the end of the restored process"
    )


def test_without_a_namespace_a_pid_in_use_is_reported(theatre, counter):
    """The source still has the pid, and is not harmed."""
    directory = theatre.dump(counter, leave="stopped")
    with pytest.raises(CriuError, match=rf"its pid {counter.pid} is in use here"):
        theatre.restore(directory, "--no-namespace")
    dump.resume(counter.pid)
    counter.counts()


# --- what cannot be restored --------------------------------------------------------------------


@pytest.mark.parametrize("pattern", ["criu/pages-1.img", "files/*"])
def test_a_flipped_byte_is_refused(theatre, pattern):
    """The size is the same. CRIU does not start, and no file on the host is replaced."""
    actor = theatre.start(f"import sys; sys.stdout = open('count', 'w')\n{COUNTER}")
    count = theatre.work / "count"
    eventually(lambda: count.exists() and count.read_text().count("\n") > 2, "its file")
    directory = theatre.dump(actor)
    count.write_text("of another process")
    [damaged] = directory.glob(pattern)
    flip_a_bit(damaged)
    shim = theatre.shim(directory)
    assert shim.process.wait(TIMEOUT) == 125
    expected = f"{directory} is damaged: {damaged.relative_to(directory)} has changed since"
    assert expected in shim.log.read_text()
    assert expected in json.loads((directory / restore_result.FILE).read_text())["reason"]
    assert not (directory / "restore.log").exists()
    assert count.read_text() == "of another process"


def flip_a_bit(path: Path) -> None:
    """Flip a bit in the middle of a file."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_an_image_without_checksums_is_restored(theatre, counter):
    """An image of a migration has none, because the transfer has a checksum of its own."""
    directory = theatre.folder / "image"
    manifest = dump.dump(
        theatre.criu, counter.pid, directory, leave="killed", timeout=TIMEOUT, checksums=False
    )
    counter.process.wait(TIMEOUT)
    assert manifest.checksums == {}
    restored = theatre.restore(directory)
    restored.counts()
    numbers = counter.numbers() + restored.numbers()
    assert numbers == list(range(1, numbers[-1] + 1))


def changed(directory: Path, **values: object) -> None:
    """Change the manifest of an image."""
    image.write(directory, replace(image.read(directory), **values))


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"working_directory": "/no/such"}, "the working directory /no/such .* is missing on"),
        ({"interpreter": "/no/python"}, "the program /no/python .* is missing on"),
        ({"machine": "vax"}, "made on vax"),
        ({"mapped": (MappedFile("/no/lib.so", 1, 0o644),)}, "/no/lib.so, which"),
        ({"mapped": (MappedFile("/etc/hostname", 1, 0o644),)}, "another one .* of 1"),
    ],
)
def test_a_missing_requirement_of_an_image_is_named(theatre, counter, values, said):
    """The error names path and host, before CRIU starts."""
    directory = theatre.dump(counter)
    changed(directory, **values)
    with pytest.raises(CriuError, match=said):
        theatre.restore(directory)


def test_a_file_that_it_reads_must_exist(theatre):
    """Files that are only read do not follow the process."""
    table = theatre.folder / "table"
    table.write_text("rows")
    actor = theatre.start(f"table = open({str(table)!r})\n{COUNTER}")
    actor.counts()
    directory = theatre.dump(actor)
    table.unlink()
    with pytest.raises(CriuError, match=f"the file {table}, which the process has open, cannot"):
        theatre.restore(directory)


def test_an_image_that_others_may_read_is_refused(theatre, counter):
    """A user who can write to the image could run any program as the user of the process."""
    directory = theatre.dump(counter)
    directory.chmod(0o755)
    with pytest.raises(CriuError, match="open to others"):
        theatre.restore(directory)


def test_a_missing_file_of_tracing_is_created(theatre, counter):
    """Every ROS process maps LTTng's shared memory, which has no content."""
    directory = theatre.dump(counter)
    path = Path(f"/dev/shm/lttng-ust-wait-rosrm-test-{os.getpid()}")
    changed(directory, mapped=(MappedFile(str(path), 4096, 0o640),))
    try:
        theatre.restore(directory)
        status = path.stat()
        assert (status.st_size, status.st_mode & 0o777) == (4096, 0o640)
    finally:
        path.unlink(missing_ok=True)


def test_criu_uses_no_pid_that_it_must_restore():
    """In a new namespace ids begin small, like those of a container's processes."""
    assert restore.id_for_criu((), 32768) == 300
    assert restore.id_for_criu((12, 13, 310), 32768) == 310
    assert restore.id_for_criu(tuple(range(1, 32700, 100)), 32768) == 300
    assert restore.id_for_criu((301, 702, 1200), 2000) == 301
