"""`rosrm collect-logs`: the collector of logs as a program."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rosrm import clocks
from rosrm.archive.retention import ArchiveLimits
from rosrm.archive.writer import ArchiveWriter
from rosrm.cli.output.plain import echo
from rosrm.client import connecting
from rosrm.client.log_collection import LogCollector
from rosrm.errors import ConfigError, NoMaster, Refused
from rosrm.runtime.disk_space import room_for
from rosrm.runtime.dispositions import handled
from rosrm.runtime.private_files import make_private_directory
from rosrm.runtime.state_lock import only_one
from rosrm.wording import reason_of

if TYPE_CHECKING:
    from rosrm.model.ros_settings import RosSettings
    from rosrm.ros.master_connection import MasterClient

#: Seconds for one search for the master, and until the archive is tried again after an error.
_SEARCH: Final = 3.0
_AGAIN: Final = 10.0
#: Files in the directory of an archive that was never written.
_UNUSED: Final = frozenset({"collector.lock", "lost+found"})


def collect(
    directory: Path, limits: ArchiveLimits, ros: RosSettings, cluster: Path | None, *,
    every: float, rate: float,
) -> None:  # fmt: skip
    """Collect logs until SIGINT or SIGTERM.

    Args:
        directory: of the archive.
        limits: bounds of the archive.
        ros: settings with which to join ROS.
        cluster: a cluster.yaml, whose `security` applies; None: that of the environment.
        every: seconds between two requests for a log with new output.
        rate: bytes per second.

    Raises:
        ConfigError: the directory cannot be used, or a key is invalid.
        Refused: another collector uses the directory, or the master has another version.
    """
    stop = threading.Event()
    with ExitStack() as closing:
        closing.enter_context(handled((signal.SIGINT, signal.SIGTERM), lambda *_: stop.set()))
        _make(directory)
        closing.enter_context(
            only_one(directory, "collector", code="duplicate", remedy="another directory")
        )
        try:
            writer = ArchiveWriter(directory, limits)
        except OSError as error:
            raise ConfigError(f"the log archive {directory} cannot be read: {error}") from None
        collector = LogCollector(writer, _say, every=every, rate=rate, stop=stop)
        security = connecting.security_mode(cluster)
        Collecting(
            collector, directory, stop,
            lambda: connecting.connect(ros, timeout=_SEARCH, security=security),
        ).run(every)  # fmt: skip


class Collecting:
    """Runs a collector; continues after a failure of the master or the disk.

    Args:
        collector: stores logs.
        directory: of the archive, for messages.
        stop: ends the run.
        connect: returns a connection to the master; raises `NoMaster`.
    """

    def __init__(
        self, collector: LogCollector, directory: Path, stop: threading.Event,
        connect: Callable[[], MasterClient],
    ) -> None:  # fmt: skip
        self._collector, self._directory, self._stop = collector, directory, stop
        self._connect = connect
        self._master: MasterClient | None = None
        self._trouble = ""

    def run(self, every: float) -> None:
        """Collect until the collector is to stop."""
        while not self._stop.is_set():
            begun = clocks.boot_time()
            wait = self._look(every)
            self._stop.wait(max(0.0, begun + wait - clocks.boot_time()))
        if self._master is not None:
            self._master.close()

    def _look(self, every: float) -> float:
        """Store new output; return the seconds until the next look."""
        try:
            if self._master is None:
                self._master = self._connect()
                _say(f"collecting the logs of all processes into {self._directory}; Ctrl-C ends")
            self._collector.look(self._master)
        except NoMaster as error:
            self._note(str(error))
        except Refused as refusal:
            if self._master is None:  # at the start: for example of another version
                raise
            self._note(str(refusal))
        except OSError as error:
            reason = reason_of(error)
            self._note(
                f"{self._directory} cannot be written: {reason}; {room_for(self._directory)}. "
                "Collecting continues when it can be written again"
            )
            return _AGAIN
        else:
            if self._trouble:
                _say(f"collecting logs into {self._directory} again")
            self._trouble = ""
        return every

    def _note(self, trouble: str) -> None:
        """Print the first failure since the last success."""
        if not self._trouble:
            _say(trouble)
        self._trouble = trouble


def _make(directory: Path) -> None:
    """Create the directory for its owner alone; refuse one that has other uses."""
    try:
        names = {file.name for file in directory.iterdir()} if directory.is_dir() else set()
        if "hosts" not in names and not names <= _UNUSED:
            raise ConfigError(
                f"{directory} has other files, and is no log archive: name a new directory"
            )
        make_private_directory(directory)
    except OSError as error:
        raise ConfigError(
            f"the log archive {directory} cannot be used: {reason_of(error)}"
        ) from None


def _say(text: str) -> None:
    echo(f"rosrm: {text}", err=True)
