"""Start and end of the cluster of `rosrm up`."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Final

from rosrm import clocks
from rosrm.cli.up import cleaner
from rosrm.errors import ConfigError, Refused, RosrmError
from rosrm.model.rows import Listing
from rosrm.runtime.log_tail import last_lines
from rosrm.runtime.private_files import make_private_directory, open_private
from rosrm.runtime.signalling import send
from rosrm.supervisor import procfs
from rosrm.testing.local_cluster import LocalCluster, Part
from rosrm.wording import ending_of, listed, reason_of

#: Seconds for all hosts to register.
_REGISTER: Final = 30.0
#: Seconds for the master to end after SIGINT, when no slave is left.
_END: Final = 10.0
#: Seconds for the end of a slave, which stops its processes first. A slave that a plugin blocks is
#: then killed, and the end of its supervisor ends the processes.
_LONGEST_END: Final = 120.0
#: Seconds between two looks at what still runs.
_LOOK: Final = 0.05
#: Lines of a log that an error shows.
_LINES: Final = 10


class PartEnded(RosrmError):
    """The master or a slave has ended without a request of `rosrm up`; its log may help."""


class StillRunning(RosrmError):
    """A process, or a part of the cluster, does not end."""


class UpCluster(LocalCluster):
    """Master and slaves in one directory, which end with this process."""

    def start(self) -> None:
        """Start the master, then the slaves, and wait until all hosts are up.

        Raises:
            RosrmError: a part was refused, for example because the domain has a master already.
        """
        master = self.start_master()
        if self.client.master_pid != master.process.pid:
            self._wait_for_refusal(master)
        for host in self.hosts:
            self.start_slave(host)
        try:
            self.wait_until("all hosts up", self._all_up, _REGISTER)
        except TimeoutError as error:
            raise RosrmError(f"{error}. The logs are in {self.directory}") from None

    def _all_up(self, view: Listing) -> bool:
        return {row.description.name for row in view.hosts if row.state == "up"} >= set(self.slaves)

    def _wait_for_refusal(self, master: Part) -> None:
        """Raise the error of a master that ends, because another master has the domain."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            master.process.wait(_END)
        self.check_parts()
        raise RosrmError(f"another master answers on {self.ros.describe()}. Stop it first")

    def check_parts(self) -> None:
        """Raise the error of a part that has ended."""
        for part in (self.master, *self.slaves.values()):
            if part is not None and part.process.poll() is not None:
                raise _error_of(part)

    _check_parts = check_parts

    def end(self) -> None:
        """Stop the slaves with their processes, supervisors that a slave has left, and the master.

        Each slave limits the time in which its processes stop.

        Raises:
            StillRunning: something does not end.
        """
        self._leave()
        for part in self.slaves.values():
            part.end()
        for part in self.slaves.values():
            if not part.wait(_LONGEST_END):  # blocked by a plugin; the supervisor is stopped below
                part.end(signal.SIGKILL)
                part.wait(_END)
        cleaner.stop_supervisors(self.directory)
        if self.master is not None:
            self.master.end()
            self.master.wait(_END)
            self._kill_master()
        self._end_others(signal.SIGTERM, signal.SIGKILL)

    def kill(self) -> None:
        """Kill the slaves, the supervisors, all processes and the master.

        Raises:
            StillRunning: something does not end.
        """
        self._leave()
        for name in list(self.slaves):
            self.switch_off(name)
        self._kill_master()
        self._end_others(signal.SIGKILL)

    def _end_others(self, *numbers: int) -> None:
        """End processes whose supervisor was killed; raise `StillRunning` if some do not end."""
        for number in numbers:
            refused = {pid: why for pid in self._left() if (why := send(pid, number))}
            until = clocks.boot_time() + _END
            while (left := self._left()) and clocks.boot_time() < until:
                time.sleep(_LOOK)
            if not left:
                return
        marks = {pid: f"{pid}: {refused[pid]}" if pid in refused else f"{pid}" for pid in left}
        names = listed(f"{what} (pid {marks[pid]})" for pid, what in left.items())
        raise StillRunning(
            f"{names} cannot be killed. A process that waits for a file system that does not "
            "answer ends when the file system answers or is unmounted"
        )

    def _left(self) -> dict[int, str]:
        """Return the pids of the processes of this cluster that still run, with their names."""
        parts = [part for part in (self.master, *self.slaves.values()) if part is not None]
        left = {part.process.pid: part.name for part in parts if not part.has_ended}
        for state in self.directory.glob("hosts/*/supervisor"):
            for mark, found in procfs.find_marked(str(state)).items():
                left.update((stat.pid, mark.rpartition("#")[0]) for stat in found)
        return left

    def _leave(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def _kill_master(self) -> None:
        if self.master is not None:
            self.master.end(signal.SIGKILL)
            self.master.wait(_END)


def _error_of(part: Part) -> RosrmError:
    """Return the error of a part that has ended: its own message, or how it ended and its log."""
    role = "master" if part.name == "master" else "slave"
    lines = last_lines(part.log)
    own = f"rosrm {role}: "
    for at, line in enumerate(lines):
        if line.startswith(own):
            return RosrmError("\n".join([line.removeprefix(own), *lines[at + 1 :]]))
    subject = "the master" if role == "master" else f"the slave of {part.name}"
    last = "".join(f"\n    {line}" for line in lines[-_LINES:])
    return PartEnded(
        f"{subject} has ended ({ending_of(part.process.returncode)}). Its log is {part.log}, in a "
        f"directory that stays; its last lines:{last}"
    )


@contextlib.contextmanager
def cleaned(directory: Path, *, keep: bool) -> Iterator[None]:
    """Claim a directory for one `rosrm up`; remove it at the end, also of a killed process.

    Args:
        directory: created if it is missing.
        keep: True: the directory stays; it stays, too, if a part has ended.

    Raises:
        Refused: another `rosrm up` uses the directory.
    """
    lock = _claim(directory)
    with subprocess.Popen(
        [sys.executable, "-I", "-S", cleaner.__file__, str(directory)],
        stdin=subprocess.PIPE, bufsize=0, pass_fds=[lock], start_new_session=True,
    ) as process:  # fmt: skip
        os.close(lock)  # the cleaner holds the lock
        assert process.stdin is not None
        if keep:
            _keep(process.stdin)
        try:
            yield
        except (PartEnded, StillRunning):
            _keep(process.stdin)
            raise


def _keep(cleaner_input: IO[bytes]) -> None:
    """Tell the cleaner that the directory stays; one that was killed removes nothing."""
    with contextlib.suppress(BrokenPipeError):
        cleaner_input.write(cleaner.KEEP)


def _claim(directory: Path) -> int:
    """Return the descriptor of the lock of a directory."""
    try:
        make_private_directory(directory)
        lock = open_private(str(directory / "up.lock"), os.O_RDWR | os.O_CREAT)
    except OSError as error:
        raise ConfigError(f"--state {directory} cannot be used: {reason_of(error)}") from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        raise Refused(
            f"another `rosrm up` runs on {directory}, or is still ending. Stop it first, or give "
            f"this one another --state"
        ) from None
    return lock
