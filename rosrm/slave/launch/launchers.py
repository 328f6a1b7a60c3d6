"""The launchers of this host, each call guarded: a fault of one costs a start or an answer."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final, TypeVar

from rosrm.errors import LaunchError, PluginError, RosrmError, describe_plugin_fault
from rosrm.extensions.contracts import (
    Capabilities,
    GraphDepartureLauncher,
    ImageLauncher,
    Launch,
    ProcessTreeLauncher,
)
from rosrm.extensions.discovery import FAULTS
from rosrm.extensions.made import MadeLauncher, MadeLaunchers
from rosrm.extensions.plugin_calls import implements, required, with_place
from rosrm.extensions.time_limit import limited
from rosrm.model.values import EMPTY, InstanceId, ProcessSpec

T = TypeVar("T")
L = TypeVar("L")

_log = logging.getLogger("rosrm.slave")

#: Seconds for `prepare`: the loop of the slave waits for it.
PREPARE_LIMIT: Final = 10.0


def _no_capabilities(_spec: ProcessSpec) -> Capabilities:
    return Capabilities()


@dataclass
class Launchers:
    """The launchers, which start instances in another way than by their plain command.

    Attributes:
        made: by name.
        unusable: name to the reason, of those that are absent or broken here.
        capabilities_of: names the launcher of a process.
    """

    made: Mapping[str, MadeLauncher] = field(default_factory=lambda: EMPTY)
    unusable: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    capabilities_of: Callable[[ProcessSpec], Capabilities] = _no_capabilities
    _logged: dict[str, str] = field(init=False, default_factory=dict)

    @classmethod
    def of(
        cls, offered: MadeLaunchers, capabilities_of: Callable[[ProcessSpec], Capabilities]
    ) -> Launchers:
        """Return the launchers of this host; log which of them cannot be used, and why."""
        absent = {name: f"absent: {reason}" for name, reason in offered.absent.items()}
        broken = {name: f"broken: {reason}" for name, reason in offered.broken.items()}
        unusable = {**absent, **broken}
        for name, reason in unusable.items():
            _log.info("launcher %s is %s", name, reason)
        return cls(offered.made, unusable, capabilities_of)

    @property
    def variables(self) -> tuple[str, ...]:
        """Environment variables that launchers set."""
        return tuple(variable for one in self.made.values() for variable in one.variables)

    def prepare(self, launch: Launch) -> Launch:
        """Return the launch as the launcher of its process changes it.

        Raises:
            LaunchError: the instance cannot be started here.
        """
        instance, restored = launch.assignment.instance, launch.assignment.restored
        spec = launch.assignment.spec
        own = spec.container.engine or self.capabilities_of(spec).launcher
        if own and own not in self.made:
            reason = self.unusable.get(own, "not installed")
            raise LaunchError(f"{instance} needs the launcher {own!r}, which is {reason}")
        # The image of a process that moves by another strategy may be of any that makes images.
        others = [name for name in self.made if name != own] if restored else []
        for name in [*([own] if own else []), *others]:
            prepared = self._prepare(name, launch)
            if prepared is not None:
                return prepared
        if restored:
            raise LaunchError(f"{instance} cannot be restored: no launcher here has an image of it")
        return launch

    def _prepare(self, name: str, launch: Launch) -> Launch | None:
        call = partial(self.made[name].launcher.prepare, launch)
        late = f"it took longer than {PREPARE_LIMIT:g} s"
        try:
            prepared = limited(PREPARE_LIMIT, call, lambda: late)
            return None if prepared is None else required(prepared, Launch)
        except PluginError as wrong:
            text = with_place(wrong, self.made[name].launcher, "prepare")
            raise LaunchError(f"the launcher {name!r} fails: prepare: {text}") from None
        except (RosrmError, ValueError) as error:
            if isinstance(error, LaunchError):
                raise
            raise LaunchError(f"{launch.assignment.instance}: {error}") from None
        except FAULTS as fault:
            reason = f"the launcher {name!r} fails: prepare: {describe_plugin_fault(fault)}"
            raise LaunchError(reason) from fault

    def discard_images(self, instance: InstanceId) -> None:
        """Have the next start of an instance begin from nothing."""
        for name, launcher in self._of(ImageLauncher):
            self._ask(name, "discard_images", partial(launcher.discard_images, instance), None)

    def has_departed(self, leader: int) -> bool:
        """Return True while the node of an instance is out of the ROS graph on purpose."""
        return any(
            self._ask(name, "has_departed", partial(launcher.has_departed, leader), False)
            for name, launcher in self._of(GraphDepartureLauncher)
        )

    def leads(self, leader: int) -> bool | None:
        """Return True if a launcher's program leads the session; None: it may do so in a moment."""
        answers = {self._leads(name, one, leader) for name, one in self._of(ProcessTreeLauncher)}
        return True if True in answers else (None if None in answers else False)

    def members(self, leader: int) -> Sequence[int]:
        """Return the leader and all processes of the instance that it leads, as far as is known."""
        for name, launcher in self._of(ProcessTreeLauncher):
            if self._leads(name, launcher, leader):
                return self._ask(name, "members", partial(launcher.members, leader), (leader,))
        return (leader,)

    def root(self, leader: int) -> int:
        """Return the pid of the process itself: the leader, if it needs no other program."""
        for name, launcher in self._of(ProcessTreeLauncher):
            if self._leads(name, launcher, leader):
                return self._ask(name, "root", partial(launcher.root, leader), leader)
        return leader

    def _leads(self, name: str, launcher: ProcessTreeLauncher, leader: int) -> bool | None:
        nothing: bool | None = False
        return self._ask(name, "leads", partial(launcher.leads, leader), nothing)

    def _of(self, contract: Callable[..., L]) -> Iterator[tuple[str, L]]:
        for name, one in self.made.items():
            launcher: object = one.launcher
            if implements(launcher, contract):
                yield name, launcher

    def _ask(self, name: str, method: str, call: Callable[[], T], otherwise: T) -> T:
        """Return the answer of a launcher, or another one where the call fails."""
        try:
            return call()
        except FAULTS as fault:
            reason = f"the launcher {name!r} fails: {method}: {describe_plugin_fault(fault)}"
            if self._logged.get(name) != reason:
                self._logged[name] = reason
                _log.info("%s", reason)
            return otherwise
