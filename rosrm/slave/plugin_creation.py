"""Creation of a host's probes and launchers, each in a thread of its own.

A plugin whose `create` hangs delays the start of its slave by `BUDGET` at most. Otherwise the host
would be lost, and processes that end when their slave does not run would end, at a restart of the
slave beside a device that does not answer.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any, Final

from rosrm import clocks, threads
from rosrm.errors import ConfigError
from rosrm.extensions.contracts import LauncherContext, ProbeContext
from rosrm.extensions.made import Probes
from rosrm.extensions.plugin_calls import Plugin, raise_alone, titled
from rosrm.extensions.registry import NameToOptions, Registry
from rosrm.slave.launch.launchers import Launchers
from rosrm.wording import listed

_log = logging.getLogger("rosrm.slave")

#: Seconds for which a starting slave waits for all its probes and launchers together: less than
#: half the default lease of a host, because it joins the ROS graph and registers after that.
BUDGET: Final = 4.0
#: Seconds between two calls during that wait.
_TICK: Final = 0.5

#: Returns the created object, or raises what its creation raised.
_Outcome = Callable[[], Any]


class PluginCreation:
    """Creation of the probes and launchers of a host; one that is late is used when it is created.

    Args:
        chosen: the probes with their options; None: the default ones.
        launchers: takes the launchers.

    Raises:
        ConfigError: a probe is unknown.
    """

    def __init__(
        self, registry: Registry, chosen: NameToOptions | None, probe_context: ProbeContext,
        launcher_context: LauncherContext, launchers: Launchers,
    ) -> None:  # fmt: skip
        self._registry, self._launchers = registry, launchers
        probes = registry.chosen_probes(chosen)
        self._listed = registry.probe_list(probes)
        self._created: SimpleQueue[tuple[Plugin, _Outcome]] = SimpleQueue()
        self._awaited: set[Plugin] = set()
        for name, options in probes.items():
            draft = partial(registry.draft_probe, name, options, probe_context)
            self._begin(("probe", name), draft)
        for name in sorted(launchers.awaited):
            self._begin(("launcher", name), partial(registry.launcher, name, launcher_context))

    @property
    def probes(self) -> Probes:
        """Return the probes; a `FailedProbe` stands for one that is not created."""
        return self._listed.probes

    def wait(self, renew: Callable[[], None], ends: Callable[[], bool]) -> None:
        """Wait until all are created, but at most `BUDGET` seconds.

        Args:
            renew: renews the fences; called about twice a second.
            ends: returns True if the slave is to end.

        Raises:
            ConfigError: the options of a probe are invalid.
        """
        until = clocks.awake_time() + BUDGET
        while self._awaited and not ends() and (left := until - clocks.awake_time()) > 0.0:
            renew()
            try:
                self._take(*self._created.get(timeout=min(left, _TICK)))
            except Empty:
                continue
        if self._awaited:
            late = listed(titled(*plugin) for plugin in sorted(self._awaited))
            _log.warning(
                "%s: not created within %g s; the slave starts, and uses what is created later",
                late, BUDGET,
            )  # fmt: skip

    def take_late(self) -> bool:
        """Take over what was created since the last call; return True if there is any."""
        before = len(self._awaited)
        while self._awaited and not self._created.empty():
            plugin, outcome = self._created.get_nowait()
            try:
                self._take(plugin, outcome)
            except ConfigError as error:  # at its start, it would have ended the slave
                self._listed.fail(plugin[1], str(error))
            _log.info("%s: its `create` has returned", titled(*plugin))
        return len(self._awaited) < before

    def _begin(self, plugin: Plugin, create: Callable[[], Any]) -> None:
        self._awaited.add(plugin)

        def work() -> None:
            self._created.put((plugin, _outcome_of(create)))

        try:
            threads.start(work, titled(*plugin))
        except RuntimeError:  # no further thread: the guard limits a call in this one
            work()

    def _take(self, plugin: Plugin, outcome: _Outcome) -> None:
        kind, name = plugin
        self._awaited.discard(plugin)
        if kind == "probe":
            self._registry.add_probe(self._listed, name, outcome)
        else:
            self._launchers.add(name, outcome)


def _outcome_of(create: Callable[[], Any]) -> _Outcome:
    """Call `create`; return a function that returns or raises the same."""
    try:
        made = create()
    except Exception as error:  # noqa: BLE001 - the loop raises it again
        return partial(raise_alone, error)
    return lambda: made
