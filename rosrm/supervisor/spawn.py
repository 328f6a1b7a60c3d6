"""Start of one process: a session leader with its output in a file, inheriting nothing else.

The forked child does all that touches a path of the user: it reads the files of secrets, enters the
working directory, searches the PATH, and executes the program. It also writes the files of its
instance. On a file system that does not answer, each of these stops the caller, even against
SIGKILL. The parent only reads the report of the child, which names the step that the child is at. A
successful exec closes the report.
"""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import selectors
import signal
import stat
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple, NoReturn

from rosrm.shortage import SHORTAGE
from rosrm.supervisor import (  # a child may be unable to load them
    descriptors,
    exec_failures,
    instance_files,
    secret_files,
)
from rosrm.supervisor.spawn_error import ScheduleRefused, SpawnError, is_transient
from rosrm.wording import reason_of

#: Seconds for the steps of one start; after them, the path of the current step has no answer.
PATIENCE: Final = 10.0
#: Bytes of one read of a report.
_PART: Final = 1 << 16
#: First letters of the messages in a report; a NUL byte ends each.
_STEP, _FAULT, _TRANSIENT_FAULT, _NO_SCHEDULE, _NO_GROUP, _UNFOUND = "@!~sgu"
#: Descriptor of the report in the child, the first one behind the standard ones.
_REPORT: Final = 3


#: Real-time policy and parameters of a process.
Scheduler = tuple[int, os.sched_param]
#: Selector that watches a report, and the function to call when the report is readable.
Watch = tuple[selectors.BaseSelector, Callable[[], None]]


class Program(NamedTuple):
    """A program to start.

    Attributes:
        argv: command line; the first word is looked up in the PATH of `environment`.
        environment: the whole environment, without the secrets.
        directory: working directory.
        secrets: variable to the path of the file with its value.
        nice: niceness; 0: that of this process. Without the right to it, that of this process.
        files: soft limit of open descriptors; None: that of this process.
        named: words of `argv` that should name files in the directory.
        is_default: the directory is the supervisor's own, in its state directory.
        contents: path to the content of a file of its instance.
    """

    argv: tuple[str, ...]
    environment: Mapping[str, str]
    directory: str
    secrets: Mapping[str, str] = {}
    nice: int = 0
    files: int | None = None
    named: tuple[str, ...] = ()
    is_default: bool = False
    contents: Mapping[str, str] = {}


class Attempt:
    """A forked process, until it has become its program or has failed to.

    Its report is watched before the fork, so no process is ever unwatched.

    Attributes:
        pid: of the process; 0: it does not exist yet.
        report: descriptor that is readable when `read` has something to do.
    """

    def __init__(self, report: int, watch: Watch | None) -> None:
        os.set_blocking(report, False)
        self.pid = 0
        self.report = report
        self._selector = watch[0] if watch else None
        self._told = b""
        if watch:
            watch[0].register(report, selectors.EVENT_READ, watch[1])

    def read(self) -> bool:
        """Read what the report has now; return True at its end."""
        try:
            while part := os.read(self.report, _PART):
                self._told += part
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """Stop watching the report, and close it."""
        if self._selector is not None:
            self._selector.unregister(self.report)
        os.close(self.report)

    @property
    def step(self) -> str:
        """Return the subject of a sentence about the path that the process waits for."""
        return next((text for kind, text in reversed(self._messages()) if kind == _STEP), "it")

    @property
    def unfound(self) -> tuple[str, ...]:
        """Return the words of `Program.named` that name nothing in the working directory."""
        return tuple(text for kind, text in self._messages() if kind == _UNFOUND)

    def check(self) -> None:
        """Raise the failure that the report has, if any.

        Raises:
            SpawnError: the process cannot be started.
            OSError: it cannot enter its control group.
        """
        for kind, text in self._messages():
            if kind == _NO_SCHEDULE:
                raise ScheduleRefused(text)
            if kind == _NO_GROUP:
                raise OSError(int(text), os.strerror(int(text)))
            if kind not in (_STEP, _UNFOUND):
                raise SpawnError(text, transient=kind == _TRANSIENT_FAULT)

    def _messages(self) -> list[tuple[str, str]]:
        texts = [os.fsdecode(one) for one in self._told.split(b"\0")[:-1]]
        return [(text[0], text[1:]) for text in texts]


def begin(
    program: Program, null: int, log: int, *, group: int = -1, scheduler: Scheduler | None = None,
    watch: Watch | None = None,
) -> Attempt:  # fmt: skip
    """Fork a process that becomes a program.

    Args:
        null: descriptor that becomes its standard input.
        log: descriptor that becomes its standard output and error.
        group: descriptor of its control group of version 2; -1: that of this process.
        scheduler: None: that of this process.
        watch: watches the report from before the fork until `Attempt.close`; None: the caller
            reads the report itself.

    Raises:
        SpawnError: no process can be forked.
        OSError: the control group is gone, or the system has no room, see `is_transient`.
    """
    report, told = os.pipe2(os.O_CLOEXEC)
    parent = os.getpid()
    with contextlib.ExitStack() as undo:
        undo.callback(os.close, report)
        try:
            attempt = Attempt(report, watch)
            undo.pop_all()
            undo.callback(attempt.close)
            attempt.pid, inside = _fork(group)
            if not attempt.pid:
                _become(program, (null, log, told), -1 if inside else group, scheduler, parent)
            undo.pop_all()  # the process exists, and nothing after this can fail
        finally:
            os.close(told)
    return attempt


def _fork(group: int) -> tuple[int, bool]:
    """Return the pid, 0 in the child, and True if the child is in its group already."""
    if group >= 0:
        from rosrm.supervisor.spawn_into import fork_into  # noqa: PLC0415 - loads 400 KiB

        pid = fork_into(group)
        if pid is not None:
            return pid, True
    try:
        return os.fork(), group < 0
    except OSError as error:
        message = f"no process can be forked: {reason_of(error)}"
        raise SpawnError(message, transient=True) from None


# --- in the child -----------------------------------------------------------------------------


def _become(
    program: Program, files: tuple[int, int, int], group: int, scheduler: Scheduler | None,
    parent: int,
) -> NoReturn:  # fmt: skip
    """Turn the child into the program, or report why that is impossible."""
    null, log, told = files

    def tell(kind: str, text: str) -> None:
        os.write(told, os.fsencode(f"{kind}{text}".replace("\0", "\\0")) + b"\0")

    try:
        os.setsid()
        _reset_signals()
        if group >= 0 and not _enter_group(group, tell):
            os._exit(127)
        if program.nice:
            with contextlib.suppress(OSError):  # the caller compares the result
                os.setpriority(os.PRIO_PROCESS, 0, program.nice)
        for descriptor, its in ((null, 0), (log, 1), (log, 2), (told, _REPORT)):
            os.dup2(descriptor, its, inheritable=its != _REPORT)
        told = _REPORT
        # A child that waits for a path must not hold the lock and the socket of its supervisor.
        os.closerange(_REPORT + 1, resource.getrlimit(resource.RLIMIT_NOFILE)[1])
        if program.files is not None:
            descriptors.lower_limit(program.files)
        _execute(program, tell, scheduler, parent)
    except SpawnError as error:
        kind = _NO_SCHEDULE if isinstance(error, ScheduleRefused) else _FAULT
        tell(_TRANSIENT_FAULT if error.transient else kind, str(error))
    except BaseException as fault:  # noqa: BLE001 - the child must not return into the caller
        kind = _TRANSIENT_FAULT if is_transient(fault) else _FAULT
        tell(kind, f"{program.argv[0]!r} cannot be started: {reason_of(fault)}")
    finally:
        os._exit(127)


def _reset_signals() -> None:
    """Reset all signals to their default; Python or the starter of the caller ignores some."""
    signal.set_wakeup_fd(-1)  # a pipe of the parent
    for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
        if signal.getsignal(number) != signal.SIG_DFL:
            signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())


def _enter_group(group: int, tell: Callable[[str, str], None]) -> bool:
    try:
        os.write(os.open("cgroup.procs", os.O_WRONLY, dir_fd=group), b"0")
    except OSError as error:
        tell(_NO_GROUP, str(error.errno))
        return False
    return True


def _execute(
    program: Program, tell: Callable[[str, str], None], scheduler: Scheduler | None, parent: int
) -> NoReturn:
    environment, directory = dict(program.environment), program.directory
    for path, content in program.contents.items():
        tell(_STEP, f"the file {path!r}")
        instance_files.provide(path, content)
    tell(_STEP, f"the working directory {directory!r}")
    _enter(directory, is_default=program.is_default)
    for word in program.named:
        tell(_STEP, f"the file {word!r} in its working directory {directory!r}")
        if _is_missing(word):
            tell(_UNFOUND, word)
    for name, path in program.secrets.items():
        tell(_STEP, f"the file {path!r} of the secret {name}")
        environment[name] = secret_files.read(name, path)
    word = program.argv[0]
    if "/" not in word:
        tell(_STEP, f"a directory of the PATH, {environment.get('PATH', os.defpath)!r},")
    path = find_executable(word, environment)
    tell(_STEP, f"the program {path!r}")
    if scheduler is not None:
        try:
            os.sched_setscheduler(0, *scheduler)
        except PermissionError:
            raise ScheduleRefused(f"{path} may not have real-time scheduling here") from None
    if os.getppid() != parent:
        os._exit(127)  # the next supervisor did not find its marks, and may start another one
    try:
        os.execve(path, program.argv, environment)  # noqa: S606 - no shell is wanted
    except OSError as error:
        reason = exec_failures.reason(os.path.join(directory, path), error)
        raise SpawnError.of(reason, error) from None
    except ValueError as error:  # a NUL byte in an argument, a "=" in a variable's name
        raise SpawnError(f"{word!r} cannot be started: {error}") from None


def _is_missing(path: str) -> bool:
    try:
        os.lstat(path)
    except OSError as error:  # the program itself reports any other error
        return error.errno in (errno.ENOENT, errno.ENOTDIR)
    return False


def _enter(directory: str, *, is_default: bool) -> None:
    try:
        os.chdir(directory)
    except FileNotFoundError as error:
        missing = f"the working directory {directory!r} cannot be entered: {reason_of(error)}"
        removed = (
            "the state directory of this host was removed under its supervisor, which therefore "
            "starts nothing more. Its processes still run and can be cancelled: cancel them, then "
            "stop the slave and start it again"
        )
        raise SpawnError(removed if is_default else missing) from None
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the path
        reason = reason_of(error)
        message = f"the working directory {directory!r} cannot be entered: {reason}"
        raise SpawnError.of(message, error) from None


def find_executable(word: str, environment: Mapping[str, str]) -> str:
    """Return the path of the program that a command's first word names. Raises SpawnError."""
    if "/" in word:
        return word
    search = environment.get("PATH", os.defpath)
    denied, unseen = "", None  # the first of each kind
    for directory in search.split(os.pathsep):
        path = os.path.join(directory or ".", word)
        try:
            is_file = stat.S_ISREG(os.stat(path).st_mode)
        except OSError as error:
            found = SpawnError.of(
                f"{path} on the PATH cannot be looked at: {reason_of(error)}", error
            )
            if error.errno in SHORTAGE:  # another directory may have another program of this name
                raise found from None
            unseen = unseen or (found if found.transient else None)
            continue
        if is_file and os.access(path, os.X_OK):
            return path
        denied = denied or (path if is_file else "")
    if denied and not unseen:
        return denied  # its exec tells why it is refused
    raise unseen or SpawnError(f"program {word!r} is not on the PATH\nthe PATH is {search}")
