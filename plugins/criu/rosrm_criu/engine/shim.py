"""Shim: restores a process and stays its parent; the supervisor starts it in place of the process.

The shim is the instance's leader. It enters a new pid namespace, where the ids of the image are
free on every host, and restores the image there. Then it forwards its signals to the restored
process, and that process's exit code or signal to the supervisor. A SIGKILL of the shim ends the
namespace, and so every process of the instance, even daemonised ones.

Processes: the shim; its child, the init of the namespace, which runs CRIU and reaps; the restored
process, a child of the init. Without the right to create a namespace (no CAP_SYS_ADMIN), the shim
itself is the parent and the ids must be free on the host. A guard process then kills the restored
process when the shim dies, as the kernel does with a namespace.

Standard library only; it runs as `python -I -S shim.py FOLDER DIRECTORY` (see
`restore_result.command`), where FOLDER contains `rosrm`.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import json
import os
import resource
import select
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NoReturn

if not __package__:
    sys.path += [str(Path(__file__).resolve().parents[2]), sys.argv.pop(1)]

from rosrm import clocks
from rosrm.errors import CriuError
from rosrm.runtime.signalling import send, send_to_group
from rosrm.supervisor.procfs import INSTANCE_MARK, SUPERVISOR_MARK
from rosrm_criu.engine import image, process_tree, put_back, restore, restore_result
from rosrm_criu.engine.binary import CriuBinary, opened
from rosrm_criu.engine.image import Manifest
from rosrm_criu.engine.restart_from_image import become
from rosrm_criu.engine.restore_result import Outcome

#: Exit code of a restore that failed.
FAILED: Final = 125

#: Constants of linux/sched.h, linux/mount.h and linux/prctl.h.
_NEW_MOUNTS: Final = 0x00020000
_NEW_PIDS: Final = 0x20000000
_SLAVE: Final = 1 << 19
_RECURSIVE: Final = 1 << 14
_SET_PDEATHSIG: Final = 1
_SET_CHILD_SUBREAPER: Final = 36

#: Signals that cannot be caught, report the shim's own children, or report its own faults.
_OWN: Final = {
    signal.SIGKILL, signal.SIGSTOP, signal.SIGCHLD, signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE,
    signal.SIGILL, signal.SIGTRAP, signal.SIGSYS, signal.SIGABRT, signal.SIGPIPE, signal.SIGTTIN,
    signal.SIGTTOU,
}  # fmt: skip
_PASSED_ON: Final = frozenset(set(signal.valid_signals()) - _OWN)

_libc = ctypes.CDLL(None, use_errno=True)


def main() -> None:
    """Restore the process, and end as it ends."""
    began = clocks.boot_time()
    words, then = _split(sys.argv[1:])
    options = _options(words)
    directory = Path(options.directory).absolute()
    try:
        is_used_up = (then or options.remove) and restore_result.was_restored(directory)
        if is_used_up and options.remove:
            image.remove(directory)  # the rest that a SIGKILL of an earlier shim left
    except OSError as error:  # the result stays as it is: the next start looks again
        sys.stderr.write(f"not restored: {error}\n")
        sys.exit(FAILED)
    if is_used_up:
        _start_without_image(directory, then)
    # Signals that arrive during the restore stay pending; only SIGKILL takes effect at once.
    signal.pthread_sigmask(signal.SIG_BLOCK, _PASSED_ON)
    try:
        manifest = image.read(directory)
        here = restore.moved_here(manifest)
        restore.check(here)
        criu = opened(Path(options.criu))
    except CriuError as error:
        _fail(directory, str(error))
    os.chdir("/")
    task = _Restore(criu, directory, manifest, here, options.timeout, options.remove, began)
    if not options.no_namespace and _libc.unshare(_NEW_PIDS) == 0:
        _restore_in_namespace(task)
    _restore_as_child(task)


def _split(words: list[str]) -> tuple[list[str], list[str]]:
    """Split the shim's own arguments from the process's command line, at the first "--"."""
    end = words.index("--") if "--" in words else len(words)
    return words[:end], words[end + 1 :]


def _options(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Restores a process and stays its parent.")
    parser.add_argument("directory", help="of the image")
    parser.add_argument("--criu", required=True, help="the program")
    parser.add_argument("--timeout", type=float, default=120.0, help="seconds for the restore")
    parser.add_argument("--remove", action="store_true", help="the image, once it is restored")
    parser.add_argument("--no-namespace", action="store_true", help="where its pids are free")
    return parser.parse_args(words)


def _start_without_image(directory: Path, command: list[str]) -> NoReturn:
    """Become the process's own program: its image was already restored, and works only once."""
    if not command:
        sys.stderr.write(f"not restored: the image {directory} was restored before\n")
        sys.exit(FAILED)
    become(command)


@dataclass(frozen=True)
class _Restore:
    """One restore: its inputs and its report."""

    criu: CriuBinary
    directory: Path
    manifest: Manifest
    here: Manifest
    timeout: float
    remove: bool
    began: float

    def run(self, marks: dict[str, str]) -> int:
        """Restore the process; return its pid in this namespace, or raise CriuError."""
        put_back.prepare(self.directory, self.here)
        log = _reopened_log()
        try:
            pid = restore.restore(
                self.criu, self.directory, self.manifest, self.here.shelter, log=log,
                timeout=self.timeout,
            )  # fmt: skip
        finally:
            os.close(log)
        for member in process_tree.tree(pid):
            restore.replace_marks(member, marks)
        return pid

    def report(self, pid: int, *, namespace: bool) -> None:
        """Report success: first write the result, for all later readers; then remove the image."""
        seconds = round(clocks.boot_time() - self.began, 3)
        inner_pid = self.manifest.pid
        outcome = Outcome(pid=pid, inner_pid=inner_pid, namespace=namespace, seconds=seconds)
        try:
            restore_result.write(self.directory, outcome)
            if self.remove:
                image.remove(self.directory)
        except OSError as error:  # the process lives, and clients that wait have a timeout
            sys.stderr.write(f"restored, but {self.directory} cannot be written: {error}\n")


def _reopened_log() -> int:
    """Return a new descriptor of standard output, opened by its path.

    Only such a descriptor belongs to this mount namespace; otherwise the next dump could not find
    the file's mount.
    """
    with contextlib.suppress(OSError):
        path = os.readlink("/proc/self/fd/1")  # noqa: PTH115 - it may be no path
        return os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)
    return os.dup(1)


def _fail(directory: Path, reason: str) -> NoReturn:
    """Report the failure in the log and in the result file, and exit."""
    sys.stderr.write(f"not restored: {reason}\n")
    with contextlib.suppress(OSError):
        restore_result.write(directory, Outcome(reason=reason))
    sys.exit(FAILED)


# --- with a namespace ---------------------------------------------------------------------------


def _restore_in_namespace(task: _Restore) -> NoReturn:
    """Fork the init of the new pid namespace, and represent it to the supervisor."""
    living, end_of_life = os.pipe()
    reports_out, reports_in = os.pipe()
    init = os.fork()
    if init == 0:
        os.close(end_of_life)
        os.close(reports_out)
        _be_init(task, living, reports_in)
    os.close(living)
    os.close(reports_in)
    with os.fdopen(reports_out) as reports:
        first = json.loads(reports.readline() or "{}")
        if "restored" not in first:
            os.waitpid(init, 0)
            _fail(task.directory, first.get("failed", "the restore was killed"))
        root = process_tree.children(init)[0]
        os.write(end_of_life, b"seen")
        task.report(root, namespace=True)
        _attend(root, init)
        last = reports.readline()
    _end_as(int(last) if last else int(signal.SIGKILL))


def _be_init(task: _Restore, living: int, reports_in: int) -> NoReturn:
    """Run as init: restore, reap every ended process, and end with the restored process."""
    code = FAILED
    try:
        _libc.prctl(_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        poll = select.poll()
        poll.register(living, 0)
        if poll.poll(0):  # the shim ended before the prctl call
            os._exit(code)
        with os.fdopen(reports_in, "w", buffering=1) as reports:
            try:
                _own_mounts()
                _skip_ids(task.manifest)
                # The namespace contains it; marks of its former host must not identify it here.
                root = task.run({INSTANCE_MARK: "", SUPERVISOR_MARK: ""})
            except (CriuError, OSError) as error:
                reports.write(json.dumps({"failed": str(error)}) + "\n")
                os._exit(code)
            reports.write(json.dumps({"restored": root}) + "\n")
            os.read(living, 16)  # until the shim has seen the process, which may end at once
            reports.write(f"{_reap_until(root)}\n")
        code = 0
    except Exception:  # noqa: BLE001 - a bug: logged, and the shim sees this process end
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stderr.flush()
        os._exit(code)


def _own_mounts() -> None:
    """Mount a /proc of this namespace; later mounts of the host still appear here."""
    done = (
        _libc.unshare(_NEW_MOUNTS) == 0
        and _libc.mount(b"none", b"/", None, _RECURSIVE | _SLAVE, None) == 0
        and _libc.mount(b"proc", b"/proc", b"proc", 0, None) == 0
    )
    if not done:
        number = ctypes.get_errno()
        raise CriuError(f"no /proc of its own could be mounted: {os.strerror(number)}")


def _skip_ids(manifest: Manifest) -> None:
    """Keep CRIU's own processes from taking ids that it is to restore."""
    most = int(Path("/proc/sys/kernel/pid_max").read_text())
    behind = restore.id_for_criu(manifest.ids, most)
    Path("/proc/sys/kernel/ns_last_pid").write_text(str(behind))


# --- without a namespace ------------------------------------------------------------------------


def _restore_as_child(task: _Restore) -> NoReturn:
    """Restore the process as a child of the shim itself."""
    _libc.prctl(_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    own = {name: os.environ.get(name, "") for name in (INSTANCE_MARK, SUPERVISOR_MARK)}
    try:
        root = task.run(own)
        guard, guarding = _start_guard(root)
    except (CriuError, OSError) as error:
        process_tree.send(
            process_tree.tree(os.getpid())[1:], signal.SIGKILL
        )  # processes that CRIU had started
        _fail(task.directory, str(error))
    task.report(root, namespace=False)
    status = _attend(root, root)
    with contextlib.suppress(OSError):  # another process killed the guard, which may be reaped
        os.write(guarding, b"ended")
        os.waitpid(guard, 0)
    _end_as(status)


def _start_guard(root: int) -> tuple[int, int]:
    """Start the guard that kills the restored process if the shim dies; return its pid and pipe."""
    living, end_of_life = os.pipe()
    reports_out, reports_in = os.pipe()
    guard = os.fork()
    if guard == 0:
        os.setsid()  # so that a SIGKILL to the shim's group does not reach it
        os.close(end_of_life)
        os.close(reports_in)
        if not os.read(living, 16):
            process_tree.send(reversed(process_tree.tree(root)), signal.SIGKILL)
        os._exit(0)
    os.close(living)
    os.close(reports_in)
    os.read(reports_out, 1)  # until the guard has its own session
    os.close(reports_out)
    return guard, end_of_life


# --- both ---------------------------------------------------------------------------------------


def _attend(root: int, child: int) -> int:
    """Forward signals until a child has ended; return its wait status.

    Args:
        root: the restored process; it leads a process group, like every process that the supervisor
            starts.
        child: the child to wait for.
    """
    awaited = {*_PASSED_ON, signal.SIGCHLD}
    signal.pthread_sigmask(signal.SIG_BLOCK, awaited)
    while (status := _reap(child, os.WNOHANG)) is None:
        number = signal.sigwaitinfo(awaited).si_signo
        if number != signal.SIGCHLD:
            send_to_group(root, number)
    return status


def _reap_until(root: int) -> int:
    status = None
    while status is None:
        status = _reap(root, 0)
    return status


def _reap(child: int, flags: int) -> int | None:
    """Reap ended children; return the wait status of `child`, or None if it still runs."""
    while True:
        pid, status = os.waitpid(-1, flags)
        if pid == child:
            return status
        if pid == 0:
            return None


def _end_as(status: int) -> NoReturn:
    """End this process with the same exit code or signal as the restored process."""
    number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
    if number:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # no core of the shim
        if number != signal.SIGKILL:
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {number})
        send(os.getpid(), number)
    sys.exit(os.waitstatus_to_exitcode(status) if not number else 128 + number)


if __name__ == "__main__":
    main()
