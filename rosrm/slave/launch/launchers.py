"""The launchers of this host, each call guarded: a fault of one costs a start or an answer."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, Final, TypeVar, cast

from rosrm import clocks
from rosrm.errors import LaunchError, PluginError, RosrmError, SkipPlugin
from rosrm.extensions.answers import MOST_VALUES, exact, whole
from rosrm.extensions.contracts import (
    Capabilities,
    GraphDepartureLauncher,
    ImageLauncher,
    Launch,
    ProcessTreeLauncher,
)
from rosrm.extensions.declared_fields import unshared
from rosrm.extensions.guard import guarded
from rosrm.extensions.made import MadeLauncher
from rosrm.extensions.plugin_calls import PluginCalls, given, implements, required, titled
from rosrm.model.values import EMPTY, InstanceId, ProcessSpec
from rosrm.slave.launch.environment import LAUNCHER
from rosrm.supervisor.procfs import read_environment, read_stat

T = TypeVar("T")
L = TypeVar("L")

_log = logging.getLogger("rosrm.slave")

#: Seconds for `prepare`, in a thread of its own: the start waits for it, the slave does not.
PREPARE_LIMIT: Final = 10.0
#: Seconds for any other call of a launcher, for which the slave's loop waits.
ASK_LIMIT: Final = 0.5
#: Maximum number of processes of an instance, and the highest pid of a kernel.
MOST_MEMBERS: Final = 32_768
_HIGHEST_PID: Final = 1 << 22
#: Ticks in a second, in which the kernel gives the start of a process.
_TICKS: Final = float(os.sysconf("SC_CLK_TCK"))
#: Maximum bytes of a command line with its environment: half of what a kernel accepts by default.
#: As JSON they are shorter than the longest line that a supervisor accepts.
MOST_BYTES: Final = 1 << 20


def _no_capabilities(_spec: ProcessSpec) -> Capabilities:
    return Capabilities()


@dataclass
class Launchers:
    """The launchers, which start instances in another way than by their plain command.

    Attributes:
        made: by name.
        unusable: name to the reason, of those that are absent or broken here.
        awaited: names of those that are still being created.
        broken: name to the reason, of those that could not be created.
        capabilities_of: names the launcher of a process; raises `PluginError` if that is unknown.
        calls: guard and record of the calls.
    """

    made: Mapping[str, MadeLauncher] = field(default_factory=lambda: EMPTY)
    unusable: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    capabilities_of: Callable[[ProcessSpec], Capabilities] = _no_capabilities
    calls: PluginCalls = field(default_factory=PluginCalls)
    awaited: frozenset[str] = frozenset()
    broken: dict[str, str] = field(init=False, default_factory=dict)
    _began: float = field(init=False, default_factory=clocks.boot_time)
    _started_by: dict[int, tuple[int, str]] = field(init=False, default_factory=dict)
    _since: dict[str, float] = field(init=False, default_factory=dict)
    _locks: dict[str, threading.Lock] = field(init=False, default_factory=dict)

    def add(self, name: str, make: Callable[[], MadeLauncher]) -> None:
        """Add a launcher that was awaited, or log why it cannot be used.

        Args:
            make: returns the launcher, or raises `SkipPlugin` or `PluginError`.
        """
        try:
            self.made = {**self.made, name: make()}
        except SkipPlugin as skip:
            reason = f"absent: {skip}"
        except PluginError as fault:
            self.broken[name] = str(fault)
            reason = f"broken: {fault}"
        else:
            reason = ""
        self.awaited -= {name}
        if reason:
            self.unusable = {**self.unusable, name: reason}
            _log.info("launcher %s is %s", name, reason)

    @property
    def failing(self) -> dict[str, str]:
        """Return the name of each launcher that is not, or not yet, created, with the reason."""
        return self.broken | dict.fromkeys(self.awaited, "its `create` has not returned yet")

    @property
    def variables(self) -> tuple[str, ...]:
        """Environment variables that launchers set."""
        return tuple(variable for one in self.made.values() for variable in one.variables)

    def prepare(self, launch: Launch) -> Launch:
        """Return the launch as the launcher of its process changes it; may take `PREPARE_LIMIT`.

        Raises:
            LaunchError: the instance cannot be started here.
        """
        instance, restored = launch.assignment.instance, launch.assignment.restored
        own = self._launcher_of(launch)
        if own and own not in self.made:
            reason = self.unusable.get(own, "not installed")
            reason = "not created yet" if own in self.awaited else reason
            raise LaunchError(f"{instance} needs the launcher {own!r}, which is {reason}")
        # The image of a process that moves by another strategy may be of any that makes images.
        others = [name for name in self.made if name != own] if restored else []
        faults: list[str] = []
        for name in [*([own] if own else []), *others]:
            try:
                prepared = self._prepare(name, launch)
            except PluginError as fault:
                if name == own:
                    raise LaunchError(str(fault)) from None
                faults.append(str(fault))
                continue
            if prepared is not None:
                # The process itself tells a later run of the slave, which knows no specs.
                environment = {**prepared.environment, LAUNCHER: name}
                return replace(prepared, environment=environment)
        if restored:
            why = "; ".join(["no launcher here has an image of it", *faults])
            raise LaunchError(f"{instance} cannot be restored: {why}")
        return launch

    def _launcher_of(self, launch: Launch) -> str:
        spec = launch.assignment.spec
        if spec.container.engine:
            return spec.container.engine
        try:
            return self.capabilities_of(spec).launcher
        except PluginError as fault:
            raise LaunchError(
                f"{launch.assignment.instance}: the launcher of the migration strategy "
                f"{spec.migration.strategy!r} is not known: capabilities: {fault}"
            ) from None

    def _prepare(self, name: str, launch: Launch) -> Launch | None:
        """Call one launcher, after its other calls; raises `PluginError` or `LaunchError`."""
        launcher: Any = self.made[name].launcher
        lock = self._locks.setdefault(name, threading.Lock())
        began = self._since.get(name, clocks.awake_time())
        if not lock.acquire(timeout=max(0.0, began + PREPARE_LIMIT - clocks.awake_time())):
            raise PluginError(
                f"the launcher {name!r} fails: prepare: an earlier call has not ended"
            )

        def ask() -> Launch | None:
            # A launcher may change its copy, and return it; the slave keeps the assignment.
            own = replace(unshared(launch), environment=dict(launch.environment))
            prepared = launcher.prepare(own)
            return None if prepared is None else _checked(launch, required(prepared, Launch))

        try:
            self._since[name] = clocks.awake_time()
            prepared = guarded(
                ask, whom=titled("launcher", name), hook="prepare", seconds=PREPARE_LIMIT,
                of=launcher, lets=(LaunchError, RosrmError, ValueError),
            )  # fmt: skip
        except PluginError as fault:
            self.calls.note(("launcher", name), "prepare", f"prepare: {fault}")
            raise PluginError(f"the launcher {name!r} fails: prepare: {fault}") from None
        except LaunchError:
            raise
        except (RosrmError, ValueError) as error:
            raise LaunchError(f"{launch.assignment.instance}: {error}") from None
        finally:
            self._since.pop(name, None)
            lock.release()
        self.calls.note(("launcher", name), "prepare")
        return prepared

    def discard_images(self, instance: InstanceId, leader: int) -> None:
        """Have the next start of an instance begin from nothing.

        Args:
            leader: pid of the leader of its session; 0: nothing of it runs.

        Raises:
            LaunchError: an image may be left, from which the next start would continue.
        """
        faults = [
            f"the launcher {name!r} is not created yet, and may have an image of it"
            for name in self.awaited if self._may_lack_launcher_of(leader)
        ]  # fmt: skip
        if not faults:  # else the instance runs on, and keeps its images
            faults = [
                fault for name, launcher in self._of(ImageLauncher)
                if (fault := self._fault_of_discarding(name, launcher, instance))
            ]  # fmt: skip
        if faults:
            raise LaunchError("; ".join(faults))

    def _fault_of_discarding(self, name: str, launcher: ImageLauncher, instance: InstanceId) -> str:
        try:
            self.calls.ask(
                "launcher", name, "discard_images",
                lambda: launcher.discard_images(instance), launcher,
            )  # fmt: skip
        except PluginError as fault:
            return f"the launcher {name!r} fails: discard_images: {fault}"
        return ""

    def has_departed(self, leader: int) -> bool | None:
        """Return True while the node of an instance is out of the ROS graph on purpose.

        None: a launcher cannot tell, so the node may be out of the graph.
        """
        answers = {
            self._ask(name, "has_departed", launcher, None, bool, leader)
            for name, launcher in self._of(GraphDepartureLauncher)
        }
        unknown = None in answers or self._may_lack_launcher_of(leader)
        return True if True in answers else (None if unknown else False)

    def members(self, leader: int) -> Sequence[int] | None:
        """Return all processes of an instance that a launcher's program leads, the leader first.

        (): no launcher's program leads it. None: a launcher cannot tell, or may not be created.
        """
        known = not self._may_lack_launcher_of(leader)
        for name, launcher in self._of(ProcessTreeLauncher):
            leads = self._leads(name, launcher, leader)
            if leads:
                return self._ask(name, "members", launcher, None, Sequence[int], leader)
            known = known and leads is not None
        return () if known else None

    def root(self, leader: int) -> int:
        """Return the pid of the process itself: the leader, as far as no launcher names another."""
        for name, launcher in self._of(ProcessTreeLauncher):
            if self._leads(name, launcher, leader):
                return self._ask(name, "root", launcher, leader, int, leader)
        return leader

    def _leads(self, name: str, launcher: ProcessTreeLauncher, leader: int) -> bool | None:
        # A launcher that fails may lead the session, so it is asked again.
        return self._ask(name, "leads", launcher, None, bool | None, leader)

    def _may_lack_launcher_of(self, leader: int) -> bool:
        """Return True if a launcher that is not created may have started an instance.

        Only a former run of the slave may have started the instance by it. The launcher may be
        absent, broken or not installed by now, such as with another PATH.
        """
        try:
            stat = read_stat(leader)
            if stat is None:  # it has ended
                return bool(self.failing)
            if stat.start / _TICKS >= self._began:
                return False
            known = self._started_by.get(leader)
            if known is None or known[0] != stat.start:
                known = self._started_by[leader] = stat.start, _launcher_in(leader)
        except OSError:  # no room for a look
            return True
        name = known[1]
        # Without a name no launcher has started it, or one of an earlier release.
        return name not in self.made if name else bool(self.failing)

    def _of(self, contract: Callable[..., L]) -> Iterator[tuple[str, L]]:
        for name, one in self.made.items():
            launcher: object = one.launcher
            if implements(launcher, contract):
                yield name, launcher

    def _ask(
        self, name: str, method: str, launcher: object, otherwise: T, hint: Any, argument: object
    ) -> T:
        """Return the answer of a launcher, or another one where the call fails."""

        def ask() -> T:
            answer = whole(getattr(launcher, method)(argument), hint, method)
            pids = answer if isinstance(answer, tuple) else (answer,) if hint is int else ()
            if len(pids) > MOST_MEMBERS:
                raise PluginError(f"{len(pids)} processes; allowed: {MOST_MEMBERS}")
            wrong = [pid for pid in pids if not 0 < pid <= _HIGHEST_PID]
            if wrong:
                raise PluginError(f"{method} has {wrong[0]!r:.30}, which is no pid")
            return answer  # type: ignore[no-any-return]

        with contextlib.suppress(PluginError):  # the guard has recorded it
            return self.calls.ask("launcher", name, method, ask, launcher)
        return otherwise


def _launcher_in(pid: int) -> str:
    """Return the launcher that the environment of a process names; "": none.

    Raises:
        OSError: no look is possible now.
    """
    prefix = f"{LAUNCHER}=".encode()
    try:
        found = (one for one in read_environment(pid) if one.startswith(prefix))
    except (FileNotFoundError, ProcessLookupError, PermissionError):  # ended, or of another user
        return ""
    return os.fsdecode(next(found, prefix).removeprefix(prefix))


def _checked(launch: Launch, prepared: Launch) -> Launch:
    """Return the launch with the prepared command line and environment; raise `PluginError`."""
    words: object = prepared.argv
    variables: object = prepared.environment
    if not isinstance(words, list | tuple) or not isinstance(variables, Mapping):
        raise PluginError("`argv` has to be a tuple, and `environment` a mapping")
    argv = tuple(map(_text, islice(words, MOST_VALUES)))
    pairs = islice(variables.items(), MOST_VALUES)
    environment = {_text(name): _text(text) for name, text in pairs}
    # The slave's own variables may have bytes that are no UTF-8; the supervisor passes them on.
    whole([one for one in argv if one not in launch.argv], list[str], "argv")
    own = launch.environment
    added = {name: text for name, text in environment.items() if own.get(name) != text}
    whole(added, Mapping[str, str], "environment")
    if not argv or not argv[0]:
        raise PluginError("`argv` is empty; a command line is required")
    wrong = next((one for one in (*argv, *added, *added.values()) if "\0" in one), None)
    if wrong is not None:
        raise PluginError(f"{wrong!r:.100} has a NUL character, which no command line can hold")
    odd = next((one for one in added if not one or "=" in one), None)
    if odd is not None:
        raise PluginError(f"`environment` has the name {odd!r:.100}, which no variable can have")
    texts = (*argv, *environment, *environment.values())
    size = sum(len(os.fsencode(one)) + 1 for one in texts)
    if size > MOST_BYTES:
        raise PluginError(f"`argv` and `environment` have {size} bytes; allowed: {MOST_BYTES}")
    return replace(launch, argv=argv, environment=environment)


def _text(word: object) -> str:
    """Return a word as a `str` itself, which may have bytes that are no UTF-8."""
    if not issubclass(type(word), str):
        raise PluginError(f"{given(word)} in `argv` or `environment`; text is required")
    return cast(str, exact(word))
