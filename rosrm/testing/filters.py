"""Contract of placement filters with the master."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np

from rosrm.core.master.scheduling.host_views import checked_mask
from rosrm.extensions.array_types import BoolArray
from rosrm.extensions.contracts import (
    FilterOffer,
    HostView,
    PlacementFilter,
    ProcessView,
)
from rosrm.extensions.plugin_calls import required
from rosrm.extensions.time_limit import CALL_LIMIT
from rosrm.model.values import EMPTY
from rosrm.testing.calls import call, made
from rosrm.testing.scoring import host_view, one_row, placements, process_view, unchanged


class FilterContract:
    """Contract of a placement filter with the master.

    Attributes:
        offer: the tested offer.
        options: by name, as in cluster.yaml; the others have their defaults.
    """

    offer: ClassVar[FilterOffer]
    options: ClassVar[Mapping[str, Any]] = EMPTY

    def make(self) -> PlacementFilter:
        """Return a new filter; override this if the filter needs more."""
        made_filter: PlacementFilter = made("filter", self.offer, self.options)
        return made_filter

    def cases(self) -> Sequence[tuple[HostView, ProcessView]]:
        """Return hosts and processes of many kinds, as passed by the master."""
        return placements(self.offer.reads)

    def _mask(self, one: PlacementFilter, hosts: HostView, process: ProcessView) -> BoolArray:
        """Return a copy of the mask, with the time limit and checks of the master."""
        count = len(hosts.names)
        mask = call("mask", CALL_LIMIT, lambda: checked_mask(one.mask(hosts, process), count), one)
        return np.array(mask)

    def test_judges_every_host(self) -> None:
        """The filter returns one boolean for each host."""
        for hosts, process in self.cases():
            self._mask(self.make(), hosts, process)

    def test_rows_are_independent(self) -> None:
        """The filter passes a host alone exactly if it passes the host among others."""
        one = self.make()
        for hosts, process in self.cases():
            together = self._mask(one, hosts, process)
            for row in range(0, len(hosts.names), 1 + len(hosts.names) // 50):
                (alone,) = self._mask(one, *one_row(hosts, process, row))
                assert alone == together[row], (
                    f"among {len(hosts.names)} hosts, {hosts.names[row]} passes: {together[row]}, "
                    f"and alone: {alone}: it depends on the other hosts"
                )

    def test_is_pure(self) -> None:
        """The filter returns the same mask for the same arguments, and does not change them."""
        one, twin = self.make(), self.make()
        for hosts, process in self.cases():
            with unchanged(hosts, process):
                first = self._mask(one, hosts, process)
                for other, whose in ((one, "the same object"), (twin, "another object")):
                    again = self._mask(other, hosts, process)
                    assert np.array_equal(again, first), (
                        f"{whose} gave another mask for the same hosts"
                    )

    def test_gives_reasons(self) -> None:
        """The filter gives a reason against every host that fails."""
        one = self.make()
        for hosts, process in self.cases():
            for row in np.flatnonzero(~self._mask(one, hosts, process))[:20]:
                ask = partial(one.reason, hosts, process, int(row))
                reason = call("reason", CALL_LIMIT, partial(_text_of, ask), one)
                assert reason, f"{hosts.names[row]} fails without a reason"

    def test_no_hosts(self) -> None:
        """The filter accepts an empty list of hosts."""
        hosts = host_view({"memory": [], "cpu": []})
        self._mask(self.make(), hosts, process_view(hosts, reads=tuple(self.offer.reads)))

    def test_offer_is_complete(self) -> None:
        """The offer has a summary of one line, which `rosrm plugins` shows."""
        assert self.offer.summary, "FilterOffer.summary is empty; `rosrm plugins` shows it"


def _text_of(ask: Callable[[], object]) -> str:
    return required(ask(), str)
