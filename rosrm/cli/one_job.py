"""One job of `rosrm run`: its spec, its placement, and its output until it has ended."""

from __future__ import annotations

import secrets
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import Final

from rosrm.cli.connection import note
from rosrm.cli.output.log_lines import LogStream, show
from rosrm.cli.waiting import show_change
from rosrm.client.client import Client
from rosrm.client.connecting import check_name
from rosrm.client.logs import PERIOD, LogReader, LogSelection
from rosrm.client.retrying import ask_until_answered
from rosrm.client.waiting import ENDED
from rosrm.config.checking import near
from rosrm.config.documents import Node, Place, node_of
from rosrm.config.work import checked_work
from rosrm.errors import ConfigError, NoMaster, Refused
from rosrm.extensions.registry import Registry
from rosrm.model.rows import HostRow, ProcessRow
from rosrm.model.values import ProcessSpec
from rosrm.wording import printable, standing

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


# --- the spec -----------------------------------------------------------------------------------


def job_of(
    command: Sequence[str], *, name: str = "", needs: Mapping[str, str],
    environment: Mapping[str, str], time_limit: str = "", directory: str = "",
) -> ProcessSpec:  # fmt: skip
    """Return the spec of a job from the words of the command line; raises `ConfigError`.

    The rules of a work file apply; a message names the option instead of a line.
    """
    if not command:
        raise ConfigError("run: no command is given; write it after --: rosrm run -- COMMAND ARG")
    fields: dict[str, Node] = {
        "name": node_of(name or _name_of(command[0]), Place("--name", 0, 0)),
        "kind": node_of("job", Place("run", 0, 0)),
        "command": node_of(list(command), Place("COMMAND", 0, 0)),
        "needs": node_of(needs, Place("--needs", 0, 0)),
        "environment": node_of(environment, Place("--env", 0, 0)),
    }
    if time_limit:
        fields["time_limit"] = node_of(time_limit, Place("--time-limit", 0, 0))
    if directory:
        fields["working_directory"] = node_of(directory, Place("--working-directory", 0, 0))
    place = Place("run", 0, 0)
    process = Node(fields, place, place)
    (spec,) = checked_work(
        Node({"processes": Node((process,), place, place)}, place), "run", registry=None
    )
    return spec


def _name_of(program: str) -> str:
    """Return the stem of a program's file with a random suffix, as a name that rosrm allows."""
    stem = "".join(
        one if one.isascii() and (one.isalnum() or one in "_-.") else "_"
        for one in Path(program).stem
    )
    return f"{stem.lstrip('-.')[:100] or 'job'}-{secrets.token_hex(2)}"


def placed(spec: ProcessSpec, on: Sequence[str], hosts: Sequence[HostRow]) -> ProcessSpec:
    """Return the spec with the labels that `--on` requires.

    Args:
        on: names of hosts, or LABEL=VALUE.
        hosts: of the cluster.

    Raises:
        ConfigError: a need or a label that no host has.
        Refused: an unknown host, or one that no label distinguishes from the others.
    """
    _check_needs(spec, hosts)
    required: dict[str, str] = {}
    for word in on:
        key, mark, value = word.partition("=")
        chosen = {key: value} if mark else _label_of(word, hosts)
        if mark and not any(row.description.labels.get(key) == value for row in hosts):
            known = sorted({f"{k}={v}" for row in hosts for k, v in row.description.labels.items()})
            raise ConfigError(f"--on {word}: no host has this label{near(word, known)}")
        required.update(chosen)
    return replace(spec, required_labels=required)


def _check_needs(spec: ProcessSpec, hosts: Sequence[HostRow]) -> None:
    """Refuse a resource that neither a host nor an installed probe measures."""
    measured = {resource.name for row in hosts for resource in row.resources}
    unknown = [name for name in spec.needs if name not in measured]
    if unknown:
        known = sorted(measured.union(Registry.discover().resources()))
        for name in unknown:
            if name not in known:
                raise ConfigError(f"--needs {name}: no probe reads {name!r}{near(name, known)}")


def _label_of(name: str, hosts: Sequence[HostRow]) -> Mapping[str, str]:
    """Return a label that one host has, and no other."""
    check_name("host", name, [row.description.name for row in hosts])
    labels = {row.description.name: row.description.labels for row in hosts}
    others = [item for host, given in labels.items() if host != name for item in given.items()]
    own = [item for item in labels[name].items() if item not in others]
    if not own:
        raise Refused(
            f"--on {name}: the host has no label of its own, by which a job could require it. "
            f"Give it one in its host.yaml, for example `labels: {{host: {name}}}`"
        )
    return dict(sorted(own, key=lambda item: item[1] != name)[:1])


# --- the run ------------------------------------------------------------------------------------


def run(client: Client, spec: ProcessSpec) -> int:
    """Submit a job, copy its output until it has ended, and return its exit code.

    SIGINT and SIGTERM cancel the job, and then the command waits for its end; a second signal ends
    the command at once.
    """
    job = _Job(client, spec.name)
    with _signals(job):
        try:
            client.submit(spec)
            return job.follow()
        except BrokenPipeError:  # nothing reads the output any more, as after `| head`
            job.cancel()
            raise
        except KeyboardInterrupt:
            pass
        try:
            job.cancel()
            if job.signal != signal.SIGHUP:  # a closed terminal takes no output
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
    before = {number: signal.signal(number, handle) for number in ending}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@dataclass
class _Job:
    """The submitted job.

    Attributes:
        signal: number of the signal that interrupted the command; 0: none.
    """

    client: Client
    name: str
    signal: int = 0
    _reader: LogReader = field(init=False)
    _begun: bool = False
    _since: float = field(default_factory=time.monotonic)
    _reported: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        (self._reader,) = self.client.log_readers([self.name], LogSelection(follow=True))
        self._reader.notify = _ignore
        self._stream = LogStream(self.name)

    def cancel(self) -> None:
        """Cancel the job, unless it has ended or was never queued."""
        with suppress(Refused):
            self.client.cancel(self.name)
        with suppress(OSError):  # a closed terminal
            note(f"cancelling {self.name}; Ctrl-C again leaves at once")

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
        listed = ask_until_answered(self.client.list_processes, note)
        return next((row for row in listed if row.name == self.name), None)

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
        if row.state in _WAITING and time.monotonic() - self._since > _PATIENCE:
            if "waits" not in self._reported:
                self._reported.add("waits")
                reason = self.client.explain(self.name)["reason"] or "no reason is known yet"
                note(f"{self.name} waits for a host: {reason}")
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
            note(printable(f"{self.name} {standing(row.state)}{reason}"))
        return _SIGNALLED - code if code < 0 else code or _FAILED


def _ignore(_text: str) -> None:
    """Take a message of the log reader that the job's own messages replace."""
