"""Reload of the master's settings: its file is read again, and becomes an event of the core."""

from __future__ import annotations

from functools import partial

from rosrm.config.placement import settings_of_chain
from rosrm.config.reloading import OF_CLUSTER, reloaded
from rosrm.config.settings import ClusterConfig
from rosrm.core.master.events import SettingsRead
from rosrm.errors import RosrmError
from rosrm.master.chain_creation import ChainCreation
from rosrm.runtime.settings_check import SettingsCheck, SettingsSource


class SettingsReload:
    """Reads the file of the master on request, and after a SIGHUP without a terminal.

    Args:
        config: the settings at the start.
        source: their origin.
        chains: creates the scoring policies with other weights and options.

    Attributes:
        chains: as the argument.
        hang_up: handler of SIGHUP.
    """

    def __init__(
        self, config: ClusterConfig, source: SettingsSource, chains: ChainCreation
    ) -> None:
        self.chains = chains
        self._config = config
        self._check = SettingsCheck(source, ClusterConfig.from_json, partial(self._take, 0))
        self.hang_up = self._check.hang_up
        self._read: list[SettingsRead] = []

    def start(self, request: int) -> None:
        """Begin to read the file; `request` is the number of a request, 0: of none."""
        self._check.start(partial(self._take, request))

    def poll(self) -> list[SettingsRead]:
        """Return the outcomes of files that were read since the last call."""
        self._check.poll()
        read, self._read = self._read, []
        return read

    def close(self) -> None:
        """End a check that runs."""
        self._check.close()

    def _take(self, request: int, new: ClusterConfig | None, fault: str) -> None:
        self._read.append(
            SettingsRead(request, fault) if new is None else self._event(request, new)
        )

    def _event(self, request: int, new: ClusterConfig) -> SettingsRead:
        same_policies = _policies(new) == _policies(self._config)
        allowed = [one for one in OF_CLUSTER if same_policies or one != "scoring"]
        read = reloaded(self._config, new, allowed)
        chain = settings_of_chain(read.config)
        try:
            self.chains(chain)
        except RosrmError as error:
            return SettingsRead(request, f"scoring: {error}")
        self._config = read.config
        return SettingsRead(request, "", read.config.core(), chain, read.changed, read.kept)


def _policies(config: ClusterConfig) -> list[str]:
    return [one.policy for one in config.scoring]
