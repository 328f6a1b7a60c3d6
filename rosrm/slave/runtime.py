"""Main loop of the slave: sample, report, request work, launch instances, watch them."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import sys
from array import array
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from rosrm import clocks
from rosrm.config.reloading import OF_HOST, reloaded
from rosrm.config.settings import HostConfig
from rosrm.core.slave import commands, reducer
from rosrm.core.slave.events import (
    DevicesMissed,
    Event,
    Registered,
    RestartOrdered,
    Slept,
    StartDelayed,
    TimePassed,
)
from rosrm.core.slave.handlers import restarts
from rosrm.core.slave.health import LOOK_PERIOD
from rosrm.core.slave.orders import event_of
from rosrm.core.slave.state import SlaveState, under_limits
from rosrm.errors import LaunchError, Refused
from rosrm.extensions.contracts import LauncherContext, ProbeContext
from rosrm.extensions.plugin_calls import TITLES, Plugin
from rosrm.extensions.plugin_deadline import Deadlines
from rosrm.extensions.process_state import ProcessState
from rosrm.extensions.registry import Registry
from rosrm.keys.security import Member
from rosrm.model.links import LinkReport
from rosrm.model.orders import (
    AmendInstance,
    MeasureLinks,
    RestartInstance,
    RunExecutor,
    SetLifecycleState,
)
from rosrm.model.rows import LogPart
from rosrm.model.values import (
    RESOURCE_SLOTS,
    Amendment,
    Component,
    HostDescription,
    InstanceId,
    InstanceState,
    InstanceStatus,
    LifecycleGoal,
)
from rosrm.ros.names import slave_node
from rosrm.ros.participant import Participant
from rosrm.ros.sealed import SealedEndpoints
from rosrm.ros.slave.artifacts import ArtifactEndpoint
from rosrm.ros.slave.component_loads import ComponentLoads
from rosrm.ros.slave.endpoint import MasterLink, SlaveEndpoint
from rosrm.ros.slave.flows import FlowSampler
from rosrm.ros.slave.graph import GraphWatch
from rosrm.ros.slave.instance_clients import InstanceClients
from rosrm.ros.slave.journal_watermark import JournalWatermark
from rosrm.ros.slave.lifecycle_nodes import LifecycleClients
from rosrm.ros.slave.replication import ReplicationEndpoint
from rosrm.ros.slave.services import Duties, ExecutorOutcome, LogQuery, SlaveServices
from rosrm.runtime import durable
from rosrm.runtime.bootstrap import end_start, handle_signals
from rosrm.runtime.path_calls import PathCalls, at
from rosrm.runtime.settings_check import Checked, SettingsCheck, SettingsSource
from rosrm.runtime.state_lock import only_one
from rosrm.slave.artifacts.service import ArtifactService
from rosrm.slave.devices import LOOK_PERIOD as LOOK_AT_DEVICES
from rosrm.slave.devices import DeviceWatch, FileFaults
from rosrm.slave.epoch import EPOCH_NOTE, EpochNote
from rosrm.slave.executors import Done, Executors
from rosrm.slave.health import HealthWatch
from rosrm.slave.interfaces import own_address
from rosrm.slave.launch.ament_index import search_path
from rosrm.slave.launch.components import filled_component
from rosrm.slave.launch.lanes import Lanes
from rosrm.slave.launch.launchers import ASK_LIMIT, PREPARE_LIMIT, Launchers
from rosrm.slave.launch.starter import Starter
from rosrm.slave.links import LinkProber
from rosrm.slave.logs import nothing_yet, read_log
from rosrm.slave.plugin_creation import PluginCreation
from rosrm.slave.replication.service import ReplicationService
from rosrm.slave.sampler import ProbeReport, Sample, Sampler
from rosrm.slave.sessions import SessionTable
from rosrm.slave.shutdown import STOP_ALL, Shutdown
from rosrm.slave.state_disk import DiskWatch
from rosrm.slave.supervisor_client import SupervisorLink
from rosrm.slave.textfile import HostMetrics, Textfile
from rosrm.slave.usage import UsageWatch
from rosrm.supervisor.paths import log_folder
from rosrm.version import __version__
from rosrm.wording import by_reason, counted, reload_summary, signal_name

_log = logging.getLogger("rosrm.slave")

#: Seconds between two checks of the ROS graph while an instance is awaited in it.
_LOOK_AT_GRAPH: Final = 0.05
#: Seconds between two measurements of the usage of each instance.
_USAGE_PERIOD: Final = 1.0
#: Seconds between two messages to the user that no master was found yet.
_LOG_PERIOD: Final = 10.0
#: The same between two warnings about a master that answers no handshake.
_IGNORED_PERIOD: Final = 600.0
#: Periods of readings for which a request stays valid at slow rates.
_BEATS_MISSED: Final = 3

#: Seconds in which `--stop-all` looks for the master before it stops the processes.
_MASTER_PATIENCE: Final = 5.0

#: Takes a summary of reloaded settings, or why they cannot be used; the other one is "".
ReloadDone = Callable[[str, str], None]
#: Takes the outcome of an order: the reason of a refusal, and its code; "": the order was executed.
Settled = Callable[[str, str], None]


class SlaveRuntime:
    """One slave.

    Args:
        security: of the slave, with its key.
        source: origin of the settings.

    Raises:
        Refused: another slave runs on this state directory.
        SupervisorError: the supervisor cannot be started or reached.
    """

    def __init__(
        self, config: HostConfig, registry: Registry, security: Member, source: SettingsSource
    ) -> None:
        self._config = config
        self._settings_check = SettingsCheck(
            source, HostConfig.from_json, self._applying(_log_reload)
        )
        self._security = security
        self._incarnation = _random_number()
        self._stopping = ""
        self._accepting = False
        self._warn_at = 0.0
        self._learns = False
        max_age = max(config.control.max_age, _BEATS_MISSED * config.period)
        self._state = SlaveState(
            max_processes=config.max_processes, max_starting=config.max_starting, max_age=max_age
        )
        self._events: deque[Event] = deque()
        self._from_threads: deque[Callable[[], None]] = deque()
        self._unsettled: dict[tuple[InstanceId, Amendment], list[Settled]] = {}
        self._unreached: dict[tuple[InstanceId, LifecycleGoal], list[Settled]] = {}
        self._executors = Executors(
            registry.executors(config.strategies), registry.broken_strategies(),
            post=self._post, changed=self._note_executors,
        )  # fmt: skip
        self._closing = contextlib.ExitStack()
        with contextlib.ExitStack() as opened:
            opened.enter_context(
                only_one(
                    config.state, "slave", code="name_taken", remedy="another `host:` and `state:`"
                )
            )
            # From here on Ctrl-C causes an orderly shutdown; before, it ends the process at once.
            handle_signals(self._stop, self._settings_check.hang_up)
            opened.callback(self._settings_check.close)
            self._calls = registry.calls
            self._calls.limit = self._deadlines = Deadlines(ASK_LIMIT)
            # Before any plugin, because fences end processes without it.
            self._open_supervisor(opened)
            self._launchers = launchers = Launchers(
                capabilities_of=registry.capabilities_or_fault(), calls=self._calls,
                awaited=frozenset(registry.names("launcher")),
            )  # fmt: skip
            sessions = SessionTable(launchers=launchers)
            self._usage = UsageWatch(sessions, self._supervisor.group_of)
            first = self._open_plugins(registry, sessions, opened)
            self._paths = PathCalls("paths of users", self._post)
            self._device_faults = FileFaults(self._paths.run, self._look_at_devices)
            self._devices = DeviceWatch(config.devices)
            self._devices.look(
                self._sampler.devices, self._sampler.awaits_devices, self._device_faults
            )
            self._textfile = Textfile(config.textfile, config.host)
            opened.callback(self._textfile.remove)
            graph = self._join_ros(opened)
            self._health = HealthWatch(self._participant, graph, sessions, launchers)
            self._clients = InstanceClients(self._participant)
            self._lifecycle_clients = LifecycleClients(self._clients, self._take)
            self._prefixes = search_path(os.environ, sys.executable)
            self._component_loads = ComponentLoads(
                self._clients, self._take, self._filled, self._paths.run
            )
            self._note_probes(first)
            self._note_broken()
            name = f"{self._participant.node.get_name()}_flows"
            self._flows = FlowSampler(lambda: self._participant.unwatched_node(name))
            self._links = LinkProber(
                config.links, key_of=security.link_key, own_id=lambda: self._endpoint.host_id,
                only=own_address(config.ros), flows=self._flows.rates,
            )  # fmt: skip
            opened.callback(self._links.close)
            self._serve_master(max_age)
            self._starter = Starter(
                config, self._snapshots, self._state, self._supervisor, self._endpoint,
                self._replication, self._artifacts, graph, sessions, launchers,
                Lanes(self._post, PREPARE_LIMIT), self._paths, take=self._take,
                instance_key=lambda one: security.instance_key(one.process, one.number),
            )  # fmt: skip
            self._ending = Shutdown(
                config, self._state, self._starter, self._supervisor, self._endpoint,
                serve=self._serve,
            )  # fmt: skip
            self._closing = opened.pop_all()
        self._adopt()

    # --- the parts -----------------------------------------------------------------------

    def _open_plugins(
        self, registry: Registry, sessions: SessionTable, opened: contextlib.ExitStack
    ) -> tuple[ProbeReport, ...]:
        """Create the probes and launchers, and read the probes once; return the reports."""
        config = self._config
        self._process = ProcessState()  # before the first of them, which may change it
        self._creation = PluginCreation(
            registry, config.probes,
            ProbeContext(config.scope, config.budget, config.state, sessions),
            LauncherContext(config.state, sys.executable, self._incarnation), self._launchers,
        )  # fmt: skip
        self._creation.wait(self._supervisor.renew, lambda: bool(self._stopping))
        self._probes = self._creation.probes
        self._sampler = Sampler(self._probes.made)
        opened.callback(self._sampler.close)
        self._limit = self._limits()
        first = self._sampler.first().reports
        self._supervisor.renew()
        self._process.restore()  # before the processes get the environment
        return first

    def _take_late_plugins(self) -> None:
        """Use the probes and launchers that were created since the start of the slave."""
        if not self._creation.take_late():
            return
        self._probes = self._creation.probes
        for former in self._sampler.rearrange(self._probes.made):
            for name in [one.name for one in former.resources] or [former.name]:
                self._endpoint.failing.pop(("probe", name), None)
        self._usage.forget()
        self._limit = self._limits()
        self._collect_failing()
        self._endpoint.describe_again(self._description())

    def _open_supervisor(self, opened: contextlib.ExitStack) -> None:
        self._supervisor = SupervisorLink(
            self._config.state / "supervisor", self._config.logs, post=self._post, take=self._take,
            follow=self._follow_session,
            ended=lambda fault: self._ending.note_supervisor_left(fault),  # noqa: PLW0108 - made later
            preparing=lambda: self._starter.preparing(),  # noqa: PLW0108 - as above
        )  # fmt: skip
        opened.callback(self._supervisor.close)
        if self._supervisor.unenforced:
            missing = by_reason((name, why) for name, why in self._supervisor.unenforced.items())
            _log.info("limits and scheduling that are not enforced here: %s", missing)

    def _join_ros(self, opened: contextlib.ExitStack) -> GraphWatch:
        """Create participant and endpoint; return the view of the ROS graph."""
        config = self._config
        self._suspends = clocks.Suspends()
        self._participant = Participant(config.ros, slave_node(config.host), pace="steady")
        opened.callback(self._participant.close)
        self._endpoints = SealedEndpoints(self._participant, self._security)
        self._endpoint = SlaveEndpoint(
            self._endpoints, self._description(), self._state, take=self._take,
            snapshots=lambda: self._replication.states(),  # noqa: PLW0108 - made later
            seen=JournalWatermark(config.state / "journal_seen", self._paths.run),
        )  # fmt: skip
        return GraphWatch(self._participant.node)

    def _note_broken(self) -> None:
        """Log and report the plugins that are broken on this host from the start."""
        self._collect_failing()
        for strategy, reason in self._executors.failing.items():
            _log.info("migration strategy %s is broken: %s", strategy, reason)

    def _serve_master(self, max_age: float) -> None:
        """Offer the services of this slave, with those of snapshot replication."""
        config = self._config
        self._disks = [DiskWatch(self._paths.run, config.state, "state directory", self._note_part)]
        self._logs = Path(log_folder(str(self._supervisor.state))).resolve()  # it may be a link
        if self._logs.stat().st_dev != config.state.stat().st_dev:
            other = DiskWatch(self._paths.run, self._logs, "log directory", self._note_part)
            self._disks.append(other)
        self._epoch_note = EpochNote(config.state / EPOCH_NOTE, self._paths.run)
        self._replication = ReplicationService(
            self._snapshots, config.host, config.keep,
            ReplicationEndpoint(self._endpoints, config.host),
            post=self._post, publish=self._endpoint.publish_snapshots,
        )  # fmt: skip
        self._artifacts = ArtifactService(
            config.state / "artifacts", config.artifacts.max_size,
            ArtifactEndpoint(self._endpoints, config.host),
            post=self._post, used=self._state.used_artifacts,
            has_master=lambda: self._is_registered,
            report=lambda one, reason: self._take(StartDelayed(one, reason)),
        )  # fmt: skip
        duties = Duties(
            self._take, self._restart, self._amend, self._set_lifecycle, self._replication.keep,
            self._drop_snapshots, self._execute, self._read_log, self._measure_links, self._reload,
        )  # fmt: skip
        self._services = SlaveServices(
            self._endpoints, duties, config.host, max_age, self._endpoint
        )

    @property
    def _snapshots(self) -> Path:
        """Return the directory of the snapshots."""
        return self._config.state / "kept"

    def _limits(self) -> array[float]:
        limit = array("f", RESOURCE_SLOTS * [1.0])
        for slot, resource in enumerate(self._sampler.resources):
            limit[slot] = self._config.limits.get(resource.name, 1.0)
        return limit

    def _description(self) -> HostDescription:
        config = self._config
        return HostDescription(
            name=config.host, incarnation=self._incarnation, hostname=socket.gethostname(),
            pid=os.getpid(), software_version=__version__,
            labels={**self._probes.labels, **config.labels},
            resources=tuple(self._sampler.resources), max_processes=config.max_processes,
            period=config.period, executors=self._executors.names, absent=self._probes.absent,
            launchers=tuple(self._launchers.made),
            unenforced=self._supervisor.unenforced, cpus=tuple(sorted(os.sched_getaffinity(0))),
            devices=self._devices.devices,
        )  # fmt: skip

    def _adopt(self) -> None:
        """Re-adopt the instances that a former run of this slave left with the supervisor."""
        held = self._supervisor.take_over()
        self._work(clocks.boot_time())
        if held:
            _log.info("%s", self._found(held))

    def _found(self, held: int) -> str:
        """Return a sentence about the processes that a former run of the slave had started."""
        live, states = self._state.live(), [one.state for one in self._state.statuses()]
        waiting = states.count(InstanceState.BACKOFF) + states.count(InstanceState.STARTING)
        running, ended = live - waiting, held - live
        phrases = [f"{counted(running, 'process', 'processes')} still run{'s' * (running == 1)}"]
        if waiting:
            phrases.append(f"{waiting} {'is' if waiting == 1 else 'are'} started again")
        if ended > 0:
            phrases.append(f"{ended} {'has' if ended == 1 else 'have'} ended")
        return ", ".join(phrases)

    # --- the loop ------------------------------------------------------------------------

    def run(self) -> int:
        """Serve until a signal to stop; returns the exit code."""
        self._supervisor.listen()
        with self._closing:
            self._serve(lambda: not self._stopping and not self._endpoint.failure)
            return self._ending.carry_out(self._stopping)

    def stop_all(self) -> int:
        """Stop the processes of a former slave, and report their ends; returns the exit code.

        The slave registers, if it finds the master in time, accepts no work, and ends.
        """
        self._stopping = STOP_ALL
        self._supervisor.listen()
        with self._closing:
            deadline = clocks.boot_time() + _MASTER_PATIENCE
            self._serve(
                lambda: (
                    not (self._is_registered or self._endpoint.failure)
                    and not self._ending.supervisor_left
                    and clocks.boot_time() < deadline
                )
            )
            reached = self._is_registered
            code = self._ending.carry_out(self._stopping)
            if not reached:
                _log.info(
                    "the master was not reached within %g s and does not know of these ends: it "
                    "lists the processes as before. The next start of this slave reports them, or "
                    "another `rosrm slave %s`",
                    _MASTER_PATIENCE, STOP_ALL,
                )  # fmt: skip
            return code

    @property
    def _is_registered(self) -> bool:
        return self._endpoint.is_registered

    @durable.lease_kept_here()
    def _serve(self, condition: Callable[[], bool]) -> None:
        end_start()
        self._process.keep_own()
        now = clocks.boot_time()
        guard = self._participant.guard  # /proc and the ROS graph may fail for a moment
        next_sample = next_usage = next_graph = next_health = next_devices = now
        logged_at = now - _LOG_PERIOD
        while condition():
            self._deadlines.begin_turn()
            if now >= next_sample:
                next_sample = max(next_sample + self._config.period, now)
                self._cycle(now)
            if now >= next_usage:
                next_usage = now + _USAGE_PERIOD
                self._clients.expire(now)
                guard.call(self._usage.look, now, self._sampler.by_process)
                guard.call(self._note_calls, now)
                guard.call(self._take_late_plugins)
                guard.call(self._process.restore)
                self._take(TimePassed())  # `_cycle` may be rare, and fences need this
            awaited = self._state.awaited_in_graph()
            if awaited and now >= next_graph:
                next_graph = now + _LOOK_AT_GRAPH
                guard.call(self._starter.look_at_graph, awaited)
            if now >= next_devices:
                next_devices = now + LOOK_AT_DEVICES
                guard.call(self._look_at_devices)
                self._look_at_name()
            guard.call(self._links.turn, now)
            if now >= next_health:
                next_health = now + LOOK_PERIOD
                guard.call(self._look_at_health, now)
            searches = self._endpoint.link is MasterLink.SEARCHING and not self._ending.has_begun
            if searches and now - logged_at >= _LOG_PERIOD:
                logged_at = now
                _log.info("looking for a master on %s", self._config.ros.describe())
            if self._endpoint.is_ignored(now) and now >= self._warn_at:
                self._warn_of_keys(now)
            self._work(now)
            wake = min(next_sample, next_usage, next_graph if awaited else next_sample)
            wake = min(wake, next_health) if self._health.watches else wake
            was_registered = self._is_registered
            self._participant.spin(max(0.0, wake - clocks.boot_time()))
            now = clocks.boot_time()
            self._work(now)
            if self._is_registered and not was_registered:
                self._cycle(now)  # the master gives no work before the first reading
            guard.call(self._services.acknowledge_starts)
            if self._accepting:  # the last assignments are being launched: ask for more
                self._endpoint.ask(now)
        guard.call(self._process.restore)  # so that the log has the end

    def _warn_of_keys(self, now: float) -> None:
        """Log that a master is there that does not answer this slave."""
        self._warn_at = now + _IGNORED_PERIOD
        _log.warning(
            "a master on %s does not answer this slave: probably the key of this host is no longer "
            "valid, because the cluster's secret was replaced (`rosrm key rotate`, a master with "
            "another secret) or the key was revoked. `rosrm key list` on the machine of the master "
            "shows the valid keys, and `rosrm key add host:%s` there makes a new one; then restart "
            "this slave. It continues to look for a master",
            self._config.ros.describe(), self._config.host,
        )  # fmt: skip

    def _look_at_devices(self) -> None:
        """Report changes of the devices to the master, and lost ones to the core."""
        sampler = self._sampler
        if self._devices.look(sampler.devices, sampler.awaits_devices, self._device_faults):
            self._endpoint.set_devices(self._devices.devices)
        if self._devices.lost:
            self._take(DevicesMissed(self._devices.lost))

    def _look_at_name(self) -> None:
        """Report another name of this machine, by which commands on it recognize their host."""
        name = socket.gethostname()
        if name != self._endpoint.description.hostname:
            _log.info("this machine is now named %r; its host is still %r", name, self._config.host)
            self._endpoint.describe_again(self._description())

    def _look_at_health(self, now: float) -> None:
        self._events.extend(self._health.look(self._state.watched(), now))

    def _stop(self, number: int, _frame: Any) -> None:
        if self._stopping:  # the handler may interrupt a log call: the loop logs instead
            self._from_threads.append(lambda: self._ending.log_progress())  # noqa: PLW0108 - as above
        self._stopping = self._stopping or signal_name(number)

    # --- reload --------------------------------------------------------------------------

    def _reload(self, done: ReloadDone) -> None:
        """Read the file of this host again; call `done` with what has changed, or the fault."""
        self._settings_check.start(self._applying(done))

    def _applying(self, done: ReloadDone) -> Checked[HostConfig]:
        """Return a function that applies checked settings, and calls `done` as in `_reload`."""
        return lambda new, fault: done("" if new is None else self._apply(new), fault)

    def _apply(self, new: HostConfig) -> str:
        """Apply the settings that need no restart, and return a summary."""
        read = reloaded(self._config, new, OF_HOST)
        self._config = read.config
        self._limit = self._limits()
        self._devices.configured = read.config.devices
        self._participant.guard.call(self._look_at_devices)
        description = self._description()
        if description != self._endpoint.description:
            self._endpoint.describe_again(description)
        return reload_summary(read.changed, read.kept)

    def _cycle(self, now: float) -> None:
        """Do the work that is due at the rate of `resource_info`."""
        self._participant.guard.call(self._settings_check.poll)
        for disk in self._disks:
            disk.look(now)
        self._note_part("supervisor", self._supervisor.trouble(now))
        self._endpoint.advance(now)
        self._epoch_note.note(self._endpoint.epoch)
        self._replication.tick(now)
        self._artifacts.tick(now)
        self._look_at_flows()
        sample = self._sampler.latest(now)
        if sample.reports:
            self._note_probes(sample.reports)
            self._endpoint.publish_statuses((), complete=False)
        present = self._sampler.present
        under = under_limits(sample.usage, self._limit, present, sample.stale)
        is_closed = self._stopping or self._ending.has_begun or self._supervisor.absence
        self._accepting = under and not is_closed
        self._endpoint.publish_reading(
            sample.usage, self._limit, present, sample.stale, accepting=self._accepting,
            processes=self._state.live(),
        )  # fmt: skip
        self._publish_usage()
        if self._textfile.is_due(now):
            self._write_textfile(sample, now)
        self._take(TimePassed())

    def _leave_out_suspend(self) -> None:
        """Prolong what processes and fetches have to do in a time (see `rosrm.clocks`)."""
        if slept := self._suspends.new():
            _log.info("this machine was suspended for %.1f s", slept)
            self._events.appendleft(Slept(slept))  # before a look at what is due
            self._starter.leave_out(slept)

    def _write_textfile(self, sample: Sample, now: float) -> None:
        """Write metrics of this host for a node exporter."""
        listed = list(enumerate(one.name for one in self._sampler.resources))
        fresh = [(slot, name) for slot, name in listed if not sample.stale >> slot & 1]
        metrics = HostMetrics(
            is_registered=self._is_registered, is_accepting=self._accepting,
            usage={name: float(sample.usage[slot]) for slot, name in fresh},
            limits={name: float(self._limit[slot]) for slot, name in listed},
            instances=self._state.statuses(),
        )  # fmt: skip
        self._textfile.is_being_written = True  # until its disk has answered, also to a late one
        written = partial(self._textfile.write, metrics, now)
        self._paths.run(written, _ignore, _ignore)

    def _note_probes(self, reports: Sequence[ProbeReport]) -> None:
        """Log which readings became stale or fresh again, and report that to the master."""
        failing = self._endpoint.failing
        for report in reports:
            _log.info("%s", report)
            for resource in report.resources or (report.probe,):
                if report.stale:
                    failing["probe", resource] = f"probe {report.probe}: {report.reason}"
                else:
                    failing.pop(("probe", resource), None)

    def _note_part(self, part: str, fault: str) -> None:
        """Log that a part of the host begins or ceases to fail, and report that to the master."""
        failing = self._endpoint.failing
        plugin: Plugin = ("probe", part)
        if failing.get(plugin, "") == fault:
            return
        if fault:
            failing[plugin] = fault
        else:
            del failing[plugin]
        _log.info("%s: %s", part, fault or "works again")
        self._endpoint.publish_statuses((), complete=False)

    def _note_executors(self, message: str) -> None:
        """Log which migration strategy fails or works again, and report that to the master."""
        _log.info("%s", message)
        self._collect_failing()
        self._endpoint.publish_statuses((), complete=False)

    def _note_calls(self, now: float) -> None:
        """Log which launcher or strategy fails or works again, and report that to the master."""
        changes = self._calls.changes(now)
        for (kind, name), error in changes:
            outcome = f"fails: {error}" if error else "works again"
            _log.info("the %s %r %s", TITLES[kind], name, outcome)
        if changes:
            self._collect_failing()
            self._endpoint.publish_statuses((), complete=False)

    def _collect_failing(self) -> None:
        """Collect the failing launchers and strategies; probes report their own changes."""
        failing = self._endpoint.failing
        for plugin in [one for one in failing if one[0] != "probe"]:
            del failing[plugin]
        failing.update({("launcher", name): why for name, why in self._launchers.failing.items()})
        failing.update(self._executors.failing_plugins())
        failing.update({plugin: one.error for plugin, one in self._calls.failing.items()})

    def _publish_usage(self) -> None:
        seen = self._usage.after_reading()
        if seen:
            used = list(seen.values())
            self._endpoint.publish_usage(
                list(seen),
                [one.cpu for one in used],
                [one.memory for one in used],
                {slot: [one.others[slot] for one in used] for slot in used[0].others},
            )

    def _measure_links(self, order: MeasureLinks, done: Callable[[LinkReport], None]) -> None:
        """Measure links, and learn flows from now on or no more."""
        self._learns = order.learn
        self._links.measure(order, done)

    def _look_at_flows(self) -> None:
        nodes = self._state.ready_nodes() if self._learns else {}
        self._participant.guard.call(self._flows.look, nodes)

    # --- core and supervisor -------------------------------------------------------------

    def _take(self, event: Event) -> None:
        """Queue an event for the core."""
        self._events.append(event)
        if isinstance(event, Registered):
            self._epoch_note.note(event.epoch)  # the master's next message may reach a node first
            self._replication.report_again()
            if self._endpoint.failing:
                self._endpoint.publish_statuses((), complete=False)

    def _post(self, call: Callable[[], None]) -> None:
        """Schedule a call in the loop; may be called from any thread."""
        self._from_threads.append(call)
        # The participant may be closed already when the last messages of the supervisor arrive.
        with contextlib.suppress(Exception):
            self._participant.wake()

    def _work(self, now: float) -> None:
        """Pass all queued events to the core, and execute its commands."""
        self._leave_out_suspend()
        self._paths.look()
        while self._from_threads:
            self._participant.guard.call(self._from_threads.popleft())
        while self._events:
            events = list(self._events)
            self._events.clear()
            reported: list[InstanceStatus] = []
            for command in reducer.step_all(self._state, events, now):
                if isinstance(command, commands.Report) and not command.complete:
                    reported += command.statuses
                else:
                    self._carry_out(command)
            if reported:
                self._endpoint.publish_statuses(reported, complete=False)

    def _carry_out(self, command: commands.Command) -> None:
        match command:
            case commands.Launch(assignments, slots):
                if not self._ending.keeps:  # the master expects no new start
                    self._starter.launch(assignments, slots)
            case commands.Report(statuses, complete):
                self._endpoint.publish_statuses(statuses, complete=complete)
            case commands.Settle(instance, amendment, refusal, code):
                for settled in self._unsettled.pop((instance, amendment), []):
                    settled(refusal, code)
            case commands.SettleLifecycle(instance, goal, refusal, code):
                for settled in self._unreached.pop((instance, goal), []):
                    settled(refusal, code)
            case commands.ReadLifecycleState() | commands.ChangeLifecycleState():
                now = clocks.boot_time()
                self._participant.guard.call(self._lifecycle_clients.send, command, now)
            case commands.ListComponents() | commands.LoadComponent():
                now = clocks.boot_time()
                self._participant.guard.call(self._component_loads.send, command, now)
            case _:
                self._have_supervisor(command)

    def _have_supervisor(self, command: commands.SupervisorCommand) -> None:
        """Send a command to the supervisor, unless the instance still waits for its start."""
        if self._starter.call_off(command):
            return
        if isinstance(command, commands.Fail):
            _log.info("%s is %s", command.instance, command.reason)
        self._supervisor.carry_out(command)

    def _filled(self, container: InstanceId, component: Component) -> Callable[[], Component]:
        """Return a function that fills the placeholders of a component."""
        return partial(
            filled_component, component, self._state.held.get(container),
            devices=self._devices.devices, artifacts=self._artifacts.root, prefixes=self._prefixes,
        )  # fmt: skip

    def _follow_session(self, status: InstanceStatus) -> None:
        self._usage.follow(status)
        if status.state.ended:
            self._starter.ended(status.instance)
            self._clients.close(status.instance)

    # --- requests of the master, and of readers of logs ----------------------------------

    def _restart(self, order: RestartInstance) -> None:
        """Restart an instance from the beginning; raises `Refused` if an image may be left."""
        event = RestartOrdered(order.instance, order.run)
        if restarts(self._state, event):
            leader = self._state.held[order.instance].status.pid
            try:
                self._starter.launchers.discard_images(order.instance, leader)
            except LaunchError as error:
                why = f"an image of it may be left, from which it would continue: {error}"
                raise Refused(why, "unable") from None
        self._take(event)

    def _amend(self, order: AmendInstance, settled: Settled) -> None:
        """Change an instance; call `settled` when the supervisor has recorded or refused it."""
        self._unsettled.setdefault((order.instance, order.amendment), []).append(settled)
        self._take(event_of(order))

    def _set_lifecycle(self, order: SetLifecycleState, settled: Settled) -> None:
        """Change the goal of a lifecycle node; call `settled` when the node has reached it."""
        self._unreached.setdefault((order.instance, order.state), []).append(settled)
        self._take(event_of(order))

    def _drop_snapshots(self, instance: InstanceId) -> None:
        """Delete the snapshots of a process, of instances up to this one."""
        lives = any(
            one.process == instance.process and one.number <= instance.number
            for one, held in self._state.held.items()
            if not held.status.state.ended
        )
        self._replication.drop(instance, lives=lives)

    def _read_log(self, query: LogQuery, done: Callable[[LogPart | Refused], None]) -> None:
        """Read a part of a log in a thread; call `done` with it, or why there is none."""
        if not query.number:
            numbers = [one.number for one in self._state.held if one.process == query.process]
            query = replace(query, number=max(numbers, default=0))
        held = self._state.held.get(InstanceId(query.process, query.number))
        ended = held is None or held.status.state.ended
        pid = 0 if held is None else held.status.pid

        def failed(error: Exception) -> None:
            if isinstance(error, Refused) and not ended:
                done(nothing_yet(query))
            elif isinstance(error, Refused):
                done(error)
            else:
                why = str(error).replace(str(self._config.state), "STATE")
                done(Refused(f"the log of {query.process} cannot be read: {why}", "unable"))

        def read() -> LogPart:
            at(self._logs)
            return read_log(self._supervisor.state, query, ended=ended, pid=pid)

        self._paths.run(read, done, failed)

    def _execute(self, order: RunExecutor, done: Done) -> None:
        """Run an executor in a thread of its own; raises `Refused`."""
        held = self._state.held.items()
        live = {str(one): it.status.pid for one, it in held if not it.status.state.ended}
        here = {
            "host": self._config.host, "state": str(self._config.state), "instances": list(live),
            # Instances that wait for a start or restart have none.
            "pids": {one: pid for one, pid in live.items() if pid},
        }  # fmt: skip
        arguments = dict(order.arguments)

        def answer(outcome: ExecutorOutcome) -> None:
            # Clients read the message; STATE stands for the state directory in it.
            message = outcome.message.replace(str(self._config.state), "STATE")
            done(outcome._replace(message=message))

        self._executors.execute(order.executor, arguments, order.timeout, here=here, done=answer)


def _ignore(_outcome: object) -> None:
    """Ignore an outcome."""


def _random_number() -> int:
    """Return a random number other than 0; unlike `secrets`, this loads no MiB of modules."""
    return int.from_bytes(os.urandom(7), "big") | 1


def _log_reload(summary: str, fault: str) -> None:
    _log.info("SIGHUP: %s", summary or f"not reloaded: {fault}")
