"""Synchronous client of the master, which the command line uses too."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, Union, cast

from rosrm import clocks
from rosrm.client.connecting import connect, ros_settings, row_of, security_mode
from rosrm.client.retrying import PERIOD, Notify, ask_until_answered, deadline_after
from rosrm.errors import Refused
from rosrm.model.applications import Target
from rosrm.model.ros_settings import RosSettings
from rosrm.model.values import ProcessSpec

if TYPE_CHECKING:
    from typing_extensions import Self

    from rosrm.archive.reader import LogArchive
    from rosrm.client.logs import LogChunk, LogReader, LogSelection
    from rosrm.client.start_traces import Trace
    from rosrm.client.waiting import OnChange, Until, WaitResult
    from rosrm.model.applications import ApplicationRow, ApplyResult
    from rosrm.model.modes import ModeRow
    from rosrm.model.rows import EventRow, HostRow, Listing, PluginRow, ProcessRow
    from rosrm.ros.master_connection import MasterClient

#: A work file by its path, a process as a work file has it, or a spec.
Work = Union[str, "os.PathLike[str]", Mapping[str, Any], ProcessSpec]
#: Path of a file.
Path = Union[str, "os.PathLike[str]"]
#: One name or several.
Names = str | Iterable[str]


def _warn(text: str) -> None:
    """Log a sentence as a warning."""
    import logging  # noqa: PLC0415 - the command line, which must be quick, has no use for it

    logging.getLogger("rosrm.client").warning(text)


class Client:
    """Synchronous client of the master; a context manager that closes its connection.

    The client finds the master as the `rosrm` command does: in the domain of ROS_DOMAIN_ID, or with
    the `ros` section of the file that ROSRM_CLUSTER names. All times are seconds. One thread uses a
    client at a time.

    Each call raises `Refused` with the master's message if the master refuses the request, and
    `NoMaster` if no answer comes in time. `wait`, `wait_for_migration`, `wait_for_drain` and
    `events` continue to ask a silent master until their own time-out.

    Args:
        domain: ROS domain; replaces ROS_DOMAIN_ID and the domain of `cluster`.
        cluster: path of a cluster.yaml whose `ros` section says how to join ROS, and whose
            `security` decides if this client uses a key.
        ros: all settings with which to join ROS, in place of `domain` and `cluster`.
        timeout: seconds for finding the master; a request is given as many, and at least 10.
        notify: takes a sentence when the master is silent, when it answers again, and when a part
            of a log cannot be read; by default a warning of the logger `rosrm.client`.
        connection: to the master, in place of all that finds one; the client closes it.

    Raises:
        NoMaster: no master answered in time, or this user has no key.
        Refused: the master is of another version.
        ConfigError: ROS cannot use a setting, `cluster` is wrong, or a key file is invalid.
        RosrmError: ROS 2 cannot be imported.
    """

    def __init__(
        self, *, domain: int | None = None, cluster: str | os.PathLike[str] | None = None,
        ros: RosSettings | None = None, timeout: float = 3.0, notify: Notify = _warn,
        connection: MasterClient | None = None,
    ) -> None:  # fmt: skip
        self._master = connection or connect(
            ros or ros_settings(domain, cluster), timeout=timeout, security=security_mode(cluster)
        )
        self._notify = notify

    # --- requests ------------------------------------------------------------------------

    def submit(self, work: Work | Iterable[Work]) -> str:
        """Queue processes, all or none, and return the master's message.

        Args:
            work: path of a work file, a process as in a work file (a mapping with `name`, `command`
                and so on), a `ProcessSpec`, or several of these.

        Raises:
            ConfigError: a file or a mapping is invalid, or an artifact cannot be read; nothing was
                queued.
        """
        return self._master.submit(self._sent(_specs(work)))

    def submit_traced(
        self, work: Work | Iterable[Work], *, timeout: float | None = None
    ) -> Mapping[str, Trace]:
        """Queue processes as `submit` does; return the trace of the start of each, by its name.

        A trace maps each hand-over to its unix time in nanoseconds, by the clock of its machine.

        Args:
            work: as for `submit`.
            timeout: seconds for the starts; None: no limit.

        Raises:
            RosrmError: a process was not started in time; the processes stay queued or run.
        """
        from rosrm.client.start_traces import submit_traced  # noqa: PLC0415 - only for traces

        specs = self._sent(_specs(work))
        return submit_traced(self._master, specs, timeout=timeout, notify=self._notify)

    def _sent(self, specs: Sequence[ProcessSpec]) -> Sequence[ProcessSpec]:
        """Send the contents of artifacts to the master; return the specs with the digests."""
        if not any(one.source for spec in specs for one in spec.artifacts):
            return specs
        from rosrm.client.artifacts import send_artifacts  # noqa: PLC0415 - only for artifacts

        return send_artifacts(self._master, specs, self._notify)

    def apply(self, work: Path | Iterable[Path], *, plan_only: bool = False) -> ApplyResult:
        """Make applications as their work files describe them, all or none.

        Args:
            work: path of a work file with `app`, or several of these.
            plan_only: True: return the actions that would follow, and begin none.

        Raises:
            ConfigError: a file is invalid or has no application, or an artifact cannot be read;
                nothing was changed.
        """
        from rosrm.config.work import load_application  # noqa: PLC0415 - imports pydantic

        files = [work] if isinstance(work, (str, os.PathLike)) else list(work)
        targets = [load_application(os.fspath(one)) for one in files]
        return self.apply_targets(targets, plan_only=plan_only)

    def apply_targets(self, targets: Sequence[Target], *, plan_only: bool = False) -> ApplyResult:
        """Make applications as their targets describe them, all or none.

        Args:
            targets: a desired state for each application.
            plan_only: True: return the actions that would follow, and begin none.

        Raises:
            ConfigError: an artifact cannot be read; nothing was changed.
        """
        sent = [self._sent_target(one) for one in targets]
        return self._master.apply(sent, plan_only=plan_only)

    def _sent_target(self, target: Target) -> Target:
        return replace(target, specs=tuple(self._sent(target.specs)))

    def revert(self, application: str, version: int, *, plan_only: bool = False) -> ApplyResult:
        """Make an earlier version of an application the desired one again.

        Args:
            application: its name.
            version: number of the version.
            plan_only: True: return the actions that would follow, and begin none.
        """
        return self._master.apply([Target(application, version=version)], plan_only=plan_only)

    def cancel_application(self, application: str) -> ApplyResult:
        """Cancel all processes of an application; its versions stay."""
        return self._master.apply([Target(application)])

    def load_modes(self, file: Path) -> str:
        """Replace the modes of the cluster by those of a file; return the master's message.

        Args:
            file: path of modes.yaml.

        Raises:
            ConfigError: the file, or a work file that it names, is invalid; nothing was sent.
        """
        from rosrm.config.modes import load_modes  # noqa: PLC0415 - imports pydantic

        modes = [
            replace(mode, targets=tuple(map(self._sent_target, mode.targets)))
            for mode in load_modes(os.fspath(file))
        ]
        return self._master.load_modes(modes)

    def switch_mode(self, mode: str, *, plan_only: bool = False) -> ApplyResult:
        """Put a mode into force.

        Args:
            mode: its name.
            plan_only: True: return the actions that would follow, and begin none.
        """
        if not plan_only:
            return self._master.switch_mode(mode)
        # Listed first: a mode that is loaded between the two requests differs from this digest.
        digests = {row.name: row.digest for row in self.list_modes()}
        planned = self._master.switch_mode(mode, plan_only=True)
        return replace(planned, work=digests.get(mode, ""), mode=mode)

    def list_modes(self) -> Sequence[ModeRow]:
        """Return all modes, in the order of their file."""
        return self.list(modes=True).modes

    def list_applications(self) -> Sequence[ApplicationRow]:
        """Return all applications with their versions."""
        return self.list(applications=True).applications

    def get_application(self, name: str) -> ApplicationRow:
        """Return an application; raise `Refused` for an unknown name."""
        return row_of("application", name, {row.name: row for row in self.list_applications()})

    def cancel(self, processes: Names, *, force: bool = False) -> str:
        """Take processes out of the queue, or stop them for good; return the master's message.

        Args:
            processes: names of the processes.
            force: True: kill them at once (SIGKILL), also those that are being stopped already.
                Only operators may.
        """
        return self._master.cancel(_list(processes), force=force)

    def restart(self, processes: Names) -> str:
        """Restart processes on their hosts, or queue ended ones; return the master's message."""
        return self._master.restart(_list(processes))

    def migrate(self, process: str, host: str | None = None) -> str:
        """Begin to move a process, and return the master's message.

        Args:
            process: name of the process.
            host: name of the destination; None: the master chooses one.
        """
        return self._master.migrate(process, host)

    def checkpoint(self, process: str) -> str:
        """Begin to checkpoint a process into an image on its host; return the master's message."""
        return self._master.checkpoint(process)

    def restore(self, process: str) -> str:
        """Begin to restore a process on the host of its image; return the master's message."""
        return self._master.restore(process)

    def cordon(self, host: str) -> str:
        """Stop assigning processes to a host; return the master's message."""
        return self._master.set_host_state(host, "cordon")

    def uncordon(self, host: str) -> str:
        """Allow new processes on a host again; return the master's message."""
        return self._master.set_host_state(host, "uncordon")

    def drain(self, host: str) -> str:
        """Cordon a host and begin to move away the processes that can leave it.

        Return the master's message: which processes can leave and which cannot.
        """
        return self._master.set_host_state(host, "drain")

    def prune(self, processes: Names = (), hosts: Names = ()) -> str:
        """Remove ended processes and departed hosts from the listings; without names: all.

        Return the master's message.
        """
        return self._master.prune(_list(processes), _list(hosts))

    def rebalance(self, *, plan_only: bool = False) -> str:
        """Begin one round of moves that even out the load of the hosts; return its moves.

        Args:
            plan_only: True: return the moves, and begin none.
        """
        return self._master.rebalance(plan_only=plan_only)

    def reload(self) -> str:
        """Let the master and its slaves read their files again; return a line for each.

        Raises:
            Refused: a file is invalid, and has changed nothing where it belongs; or no operator.
        """
        return self._master.reload()

    # --- listings ------------------------------------------------------------------------

    def list(  # noqa: PLR0913 - the parts of one listing
        self, *, hosts: bool = False, processes: bool = False,
        plugins: bool | Literal["failing"] = False, applications: bool = False,
        modes: bool = False, events: bool = False, process: str = "", host: str = "",
        after: int = 0, newest: int = 0, on_wait: Callable[[float], None] | None = None,
    ) -> Listing:  # fmt: skip
        """Return the requested listings; one request reads all of them.

        Args:
            hosts: True: list the hosts.
            processes: True: list the processes.
            plugins: True: list all plugins; "failing": only the failing ones.
            applications: True: list the applications.
            modes: True: list the modes.
            events: True: list events, the oldest first.
            process: limit processes and events to this process; "": all.
            host: limit events to this host; "": all.
            after: limit events to those after this sequence.
            newest: most events; 0: 1000.
            on_wait: called about every 0.1 s while the master does not answer, with the seconds
                since the request; an exception that it raises ends the request.
        """
        return self._master.list(
            hosts=hosts, processes=processes, plugins=plugins, applications=applications,
            modes=modes, events=events, process=process, host=host, after=after, newest=newest,
            on_wait=on_wait,
        )  # fmt: skip

    def list_processes(self) -> Sequence[ProcessRow]:
        """Return all processes, including ended ones."""
        return self.list(processes=True).processes

    def list_hosts(self) -> Sequence[HostRow]:
        """Return all hosts."""
        return self.list(hosts=True).hosts

    def list_plugins(self) -> Sequence[PluginRow]:
        """Return the plugins of the master and of all hosts, with their states."""
        return self.list(plugins=True).plugins

    def master_load(self) -> Mapping[str, float]:
        """Return figures of the master's newest load; empty: none has arrived yet.

        The first call begins to follow them. They arrive once a second, during other requests.
        """
        return self._master.load()

    def get_process(self, name: str) -> ProcessRow:
        """Return a process; raise `Refused` for an unknown name."""
        return row_of("process", name, {row.name: row for row in self.list_processes()})

    def get_host(self, name: str) -> HostRow:
        """Return a host; raise `Refused` for an unknown name."""
        return row_of("host", name, {row.description.name: row for row in self.list_hosts()})

    def explain(self, process: str) -> Mapping[str, Any]:
        """Return the reasons for a process's placement or wait, as `rosrm explain --json`."""
        return self._explained(process, lambda: self.get_process(process))

    def explain_host(self, host: str) -> Mapping[str, Any]:
        """Return why processes have to leave a host, and why they do not.

        The member `reasons` has a sentence for its drain and for each limit that is exceeded.
        """
        from rosrm.model.rows import HOST_MARK  # noqa: PLC0415 - loads with the first listing

        return self._explained(f"{HOST_MARK}{host}", lambda: self.get_host(host))

    def _explained(self, name: str, look_up: Callable[[], object]) -> Mapping[str, Any]:
        """Return an explanation; `look_up` refuses an unknown name, and names the nearest."""
        try:
            return self._master.explain(name)
        except Refused as refusal:
            if refusal.code == "unknown":
                look_up()
            raise

    # --- events and logs -----------------------------------------------------------------

    def events(
        self, *, process: str = "", host: str = "", after: int = 0, newest: int = 0,
        follow: bool = False, timeout: float | None = None,
    ) -> Iterator[EventRow]:  # fmt: skip
        """Yield events of the cluster, the oldest first.

        Args:
            process: name of the process of the events; "": all.
            host: name of the host of the events; "": all.
            after: sequence before the first event, for example that of the last received one.
            newest: most existing events; 0: 1000.
            follow: True: then yield new events until the time-out.
            timeout: seconds of following; None: no limit.
        """
        from rosrm.client.event_feed import ALL, EventFeed  # noqa: PLC0415 - only for events

        def ask(process: str, host: str, after: int, newest: int) -> Listing:
            def look(on_wait: Callable[[float], None]) -> Listing:
                return self.list(
                    events=True, process=process, host=host, after=after, newest=newest,
                    on_wait=on_wait,
                )  # fmt: skip

            return ask_until_answered(look, self._notify, deadline if follow else 0.0)

        deadline = deadline_after(timeout)
        feed = EventFeed(partial(ask, process, host), after, newest)
        yield from feed.new()
        if process or host:  # a selection lacks the event by which a journal gap is noticed
            feed = EventFeed(partial(ask, "", ""), feed.listing.last_sequence, 0, feed.known)
        while follow and clocks.boot_time() < deadline:
            events: Sequence[EventRow] = list(feed.new())
            if events and (process or host):
                new = {one.sequence for one in events}
                selected = ask(process, host, min(new) - 1, ALL).events
                events = [one for one in selected if one.sequence in new]
            yield from events
            time.sleep(PERIOD)

    def logs(
        self, process: str, *, tail: int = 0, since: float = 0.0, host: str = "",
        follow: bool = False, timeout: float | None = None,
    ) -> Iterator[LogChunk]:  # fmt: skip
        """Yield the output of a process over restarts and migrations, the oldest first.

        Args:
            process: name of the process.
            tail: number of last lines; 0: all lines.
            since: unix time of the oldest output; 0: all output.
            host: name of the host of the output; "": all hosts.
            follow: True: then yield new output until the process has ended, or until the time-out.
            timeout: seconds of following; None: no limit.

        Raises:
            Refused: the process has no log, or its host is not up.
            NoMaster: master or slave did not answer.
        """
        from rosrm.client import logs  # noqa: PLC0415 - only for logs

        deadline = deadline_after(timeout)
        selection = logs.LogSelection(tail, since, host, follow)
        (reader,) = self.log_readers([process], selection)
        yield from reader.read()
        while follow and not reader.at_end and clocks.boot_time() < deadline:
            chunk = reader.poll()
            if chunk is not None:
                yield chunk
            elif not reader.at_end:
                time.sleep(logs.PERIOD)

    def log_readers(
        self, processes: Sequence[str], selection: LogSelection, archive: LogArchive | None = None
    ) -> Sequence[LogReader]:
        """Return a reader for the log of each process; all of them ask a silent host once.

        With an archive they also read the collected logs of hosts that are gone.
        """
        from rosrm.client.logs import LogReader  # noqa: PLC0415 - as above

        silent: dict[str, str] = {}
        return [
            LogReader(self._master, name, selection, self._notify, silent, archive)
            for name in processes
        ]

    # --- waiting -------------------------------------------------------------------------

    def wait(
        self, processes: Names, *, until: Until = "settled", timeout: float | None = None,
        previous: Iterable[ProcessRow] | None = None, on_change: OnChange | None = None,
    ) -> WaitResult:  # fmt: skip
        """Wait for processes, and return the result, which is true if all are done.

        The wait ends early when only a user or another host can help: a process has failed, is
        stuck, or is set aside.

        Args:
            processes: by their names.
            until: "settled": each job has ended, or waits for the next run of its schedule after a
                run without a failure, and each service runs. "ended": each process has
                ended, whatever the cause.
            timeout: seconds; None: no limit.
            previous: after a restart: the rows of `list_processes` from before; each process is
                then awaited until it runs in another run.
            on_change: takes the row of a process that is not done, with each change of its state.

        Raises:
            NoMaster: the master was silent when the time-out passed.
        """
        from rosrm.client import waiting  # noqa: PLC0415 - for those who wait

        return waiting.wait_for_processes(
            self._master, _list(processes), until, timeout=timeout, previous=previous,
            on_change=on_change or _ignore, notify=self._notify,
        )  # fmt: skip

    def wait_for_migration(
        self, process: str, *, after: int, timeout: float | None = None,
        on_change: OnChange | None = None,
    ) -> WaitResult:  # fmt: skip
        """Wait until a migration, checkpoint or restore has ended; the result is true if done.

        Args:
            process: by its name.
            after: sequence of the newest event before the request: `client.list().last_sequence`.
            timeout: seconds; None: no limit.
            on_change: takes the row of the process with each change of its state.

        Raises:
            NoMaster: the master was silent when the time-out passed.
        """
        from rosrm.client import waiting  # noqa: PLC0415 - for those who wait

        return waiting.wait_for_migration(
            self._master, process, after=after, timeout=timeout, on_change=on_change or _ignore,
            notify=self._notify,
        )  # fmt: skip

    def wait_for_applications(
        self, names: Names, *, timeout: float | None = None,
        on_change: Callable[[ApplicationRow], None] | None = None,
    ) -> Sequence[ApplicationRow]:  # fmt: skip
        """Wait until no process of the applications is to be changed; return the last rows.

        Args:
            names: of the applications.
            timeout: seconds; None: no limit.
            on_change: takes the row of an application with each change of its pending processes.

        Raises:
            NoMaster: the master was silent when the time-out passed.
        """
        from rosrm.client import waiting  # noqa: PLC0415 - for those who wait

        return waiting.wait_for_applications(
            self._master, _list(names), timeout=timeout, on_change=on_change or _ignore,
            notify=self._notify,
        )  # fmt: skip

    def wait_for_mode(
        self, *, timeout: float | None = None,
        on_change: Callable[[ApplicationRow], None] | None = None,
    ) -> Sequence[ModeRow]:  # fmt: skip
        """Wait until no switch of modes is under way; return the last rows.

        The arguments are those of `wait_for_applications`.
        """
        from rosrm.client import waiting  # noqa: PLC0415 - for those who wait

        return waiting.wait_for_mode(
            self._master, timeout=timeout, on_change=on_change or _ignore, notify=self._notify
        )

    def wait_for_drain(
        self, host: str, *, after: int, timeout: float | None = None
    ) -> WaitResult:  # fmt: skip
        """Wait until a host is drained; the result is true if no process has stayed there.

        The arguments are those of `wait_for_migration`.
        """
        from rosrm.client import waiting  # noqa: PLC0415 - for those who wait

        return waiting.wait_for_drain(
            self._master, host, after=after, timeout=timeout, notify=self._notify
        )

    # --- the end -------------------------------------------------------------------------

    def close(self) -> None:
        """Leave ROS."""
        self._master.close()

    def __enter__(self) -> Self:
        """Return the client."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the client."""
        self.close()


def _ignore(_row: object) -> None:
    """Take a change that no caller wants."""


def _list(names: Names) -> Sequence[str]:
    return [names] if isinstance(names, str) else list(names)


def _specs(work: Work | Iterable[Work]) -> Sequence[ProcessSpec]:
    """Return the specs of work files and of processes, in their order."""
    is_one = isinstance(work, (str, os.PathLike, Mapping, ProcessSpec))
    several = cast("Iterable[Work]", [work] if is_one else work)
    return [spec for one in several for spec in _specs_of(one)]


def _specs_of(work: Work) -> Sequence[ProcessSpec]:
    if isinstance(work, ProcessSpec):
        return [work]
    from rosrm.config import work as work_files  # noqa: PLC0415 - pydantic only where it is needed

    if isinstance(work, Mapping):
        return work_files.processes_of(work)
    return work_files.load_work(os.fspath(work))
