"""Run of the job of `rosrm run`: submission, output, and the exit code at its end."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from types import FrameType
from typing import TYPE_CHECKING, Final, TypeVar

from rosrm import clocks
from rosrm.cli.connection import note
from rosrm.cli.output.log_lines import LogStream, show
from rosrm.cli.waiting import show_change
from rosrm.client.client import Client
from rosrm.client.logs import PERIOD, LogReader, LogSelection
from rosrm.client.retrying import ask_until_answered, deadline_after
from rosrm.client.waiting import ENDED
from rosrm.errors import NoMaster, Refused
from rosrm.model.rows import ProcessRow
from rosrm.model.values import ProcessSpec
from rosrm.ros.deferred_signals import signals_deferred
from rosrm.runtime.dispositions import handled
from rosrm.wording import standing

if TYPE_CHECKING:
    from rosrm.ros.master_connection import OnWait

T = TypeVar("T")

#: Seconds in the queue after which the command says why the job waits.
_PATIENCE: Final = 1.0
#: States in which a job has no host yet.
_WAITING: Final = frozenset({"queued", "set_aside"})
#: States that the command reports, once each.
_NOTEWORTHY: Final = frozenset({"unreachable", "unknown", "stuck"})
#: Exit code of a job that has failed without an exit code of its own.
_FAILED: Final = 1
#: Exit code of a program that a signal has ended is this plus its number, as in a shell.
_SIGNALLED: Final = 128


def run_job(client: Client, spec: ProcessSpec, patience: float | None) -> int:
    """Submit a job, copy its output until it has ended, and return its exit code.

    SIGINT and SIGTERM cancel the job, and then the command waits for its end; a second signal ends
    the command at once.

    Args:
        client: asks the master.
        spec: of the job.
        patience: seconds of silence of the master after which the command ends; None: no bound.

    Raises:
        NoMaster: the master was silent for so long; the job may still run.
    """
    job = _Job(client, spec.name, patience)
    with _signals(job):
        try:
            with signals_deferred():
                client.submit(spec)
                job.is_queued = True
            return job.follow()
        except BrokenPipeError:  # nothing reads the output any more, as after `| head`
            job.cancel()
            raise
        except KeyboardInterrupt:
            pass
        try:
            if job.cancel() and job.signal != signal.SIGHUP:  # a closed terminal takes no output
                job.follow()
        except KeyboardInterrupt:
            note(
                f"{spec.name} may still be stopping: `rosrm ps` shows its state, "
                f"`rosrm logs -f {spec.name}` its output"
            )
        return _SIGNALLED + job.signal


@contextmanager
def _signals(job: _Job) -> Iterator[None]:
    """Raise `KeyboardInterrupt` for each signal that ends programs, and note the first one."""

    def handle(number: int, _frame: FrameType | None) -> None:
        job.signal = job.signal or number
        raise KeyboardInterrupt

    ending = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    with handled(ending, handle):
        yield


@dataclass
class _Job:
    """The submitted job.

    Attributes:
        patience: seconds of silence of the master after which a wait for it fails; None: no bound.
        is_queued: the master has accepted the job. Otherwise its name may be another process's.
        signal: number of the signal that interrupted the command; 0: none.
    """

    client: Client
    name: str
    patience: float | None = None
    is_queued: bool = False
    signal: int = 0
    _reader: LogReader = field(init=False)
    _begun: bool = False
    _since: float = field(default_factory=clocks.boot_time)
    _reported: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        (self._reader,) = self.client.log_readers([self.name], LogSelection(follow=True))
        self._reader.notify = _ignore
        self._stream = LogStream(self.name)

    def cancel(self) -> bool:
        """Cancel the job, unless it has ended or was never queued; return True if it will end."""
        if not self.is_queued:
            return False
        text = f"cancelling {self.name}; Ctrl-C again leaves at once"
        try:
            self.client.cancel(self.name)
        except Refused:
            pass  # it has ended
        except NoMaster:
            text = (
                f"the master does not answer, so {self.name} is not cancelled; once the master "
                f"runs again, `rosrm cancel {self.name}` ends it"
            )
        with suppress(OSError):  # a closed terminal
            note(text)
        return text.startswith("cancelling")

    def follow(self) -> int:
        """Copy the output of the job until it has ended; return the exit code."""
        while True:
            row = self._row()
            has_ended = row is None or row.state in ENDED
            if row is not None and not has_ended:
                self._report(row)
            news = self._copy(has_ended=has_ended)
            if has_ended and not news:
                return self._exit_code(row)
            if not news:
                time.sleep(PERIOD)

    def _row(self) -> ProcessRow | None:
        try:
            view = self._ask(lambda on_wait: self.client.list(processes=True, on_wait=on_wait))
        except NoMaster as error:
            raise NoMaster(
                f"no longer waiting for {self.name}, which may still run: `rosrm logs -f "
                f"{self.name}` follows it once the master runs again. {error}"
            ) from None
        return next((row for row in view.processes if row.name == self.name), None)

    def _ask(self, look: Callable[[OnWait], T]) -> T:
        """Return an answer of the master; raise `NoMaster` after a silence of `patience`."""
        return ask_until_answered(look, note, deadline_after(self.patience))

    def _copy(self, *, has_ended: bool) -> bool:
        """Copy new output; return False if there was none."""
        try:
            news = self._read() if not self._begun and has_ended else self._poll()
        except NoMaster as error:
            self._reader.silent.clear()  # ask the host again, because the job may run for hours
            self._note_once(str(error))
            return False
        except Refused as refusal:
            if not has_ended:  # otherwise its end says more, e.g. that it could not be started
                self._note_once(str(refusal))
            return False
        show(self._stream.take())
        return news

    def _read(self) -> bool:
        """Copy the whole log of a job that has ended before its first output was read."""
        self._begun = True
        for chunk in self._reader.read():
            self._stream.write(chunk)
            show(self._stream.take())
        return False

    def _poll(self) -> bool:
        chunk = self._reader.poll()
        if chunk is None:
            return False
        self._begun = True
        self._stream.write(chunk)
        return True

    def _report(self, row: ProcessRow) -> None:
        """Report once why the job waits, and each state that needs the user's attention."""
        if row.state in _WAITING and clocks.boot_time() - self._since > _PATIENCE:
            if "waits" not in self._reported:
                self._reported.add("waits")
                story = self._ask(lambda _: self.client.explain(self.name))
                note(f"{self.name} waits for a host: {story['reason'] or 'no reason is known yet'}")
                if row.state == "set_aside":
                    note("Ctrl-C cancels it; then run it again with other `--needs` or `--on`")
        elif row.state in _NOTEWORTHY and row.state not in self._reported:
            self._reported.add(row.state)
            show_change(row)

    def _note_once(self, text: str) -> None:
        if text not in self._reported:
            self._reported.add(text)
            note(text)

    def _exit_code(self, row: ProcessRow | None) -> int:
        """Return the exit code of the job, and print why it has none."""
        if row is None:
            note(f"{self.name} is no longer listed (`rosrm events --process {self.name}`)")
            return _FAILED
        if row.state == "finished":
            return 0
        code = row.exit_code or 0
        if not self.signal and row.reason != f"exit code {code}":
            reason = f": {row.reason}" if row.reason else ""
            note(f"{self.name} {standing(row.state)}{reason}")
        return _SIGNALLED - code if code < 0 else code or _FAILED


def _ignore(_text: str) -> None:
    """Take a message of the log reader that the job's own messages replace."""
