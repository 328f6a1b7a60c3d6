"""Contract of checkpoint policies with the master."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import islice, permutations
from typing import Any, ClassVar, Final

from rosrm.core.master.checkpoint.periodic import sound_pace
from rosrm.core.master.checkpoint.replication import sound_choice
from rosrm.extensions.contracts import (
    CheckpointChoice,
    CheckpointOffer,
    CheckpointPolicy,
    CheckpointView,
    MemoryPacing,
    MemoryView,
)
from rosrm.extensions.plugin_calls import implements
from rosrm.extensions.time_limit import CALL_LIMIT
from rosrm.model.values import EMPTY, MigrationPolicy, ProcessSpec
from rosrm.testing.calls import call, made

#: Number of orders of the replicas' hosts that are tested.
_ORDERS: Final = 24


class CheckpointContract:
    """Contract of a checkpoint policy with the master.

    Attributes:
        offer: the tested offer.
        options: by name, as in cluster.yaml; the others have their defaults.
        spec: of a stateful process.
    """

    offer: ClassVar[CheckpointOffer]
    options: ClassVar[Mapping[str, Any]] = EMPTY
    spec: ClassVar[ProcessSpec] = ProcessSpec(
        "p", command=("true",), ros=True, migration=MigrationPolicy("handoff")
    )

    def make(self) -> CheckpointPolicy:
        """Return a new policy; override this if the policy needs more."""
        policy: CheckpointPolicy = made("checkpoint", self.offer, self.options)
        return policy

    def _choice(self, policy: CheckpointPolicy, view: CheckpointView) -> CheckpointChoice | None:
        """Return a choice, with the time limit and checks of the master."""
        return call("choose", CALL_LIMIT, lambda: sound_choice(policy.choose(view), view), policy)

    def views(self) -> Sequence[CheckpointView]:
        """Return views of a process: without a replica, with replicas, and on the only host."""
        hosts = {f"h{n}": {"rack": str(n % 2), "room": "1"} for n in range(5)}
        fresh = CheckpointView(self.spec, "h0", None, 1000, (), hosts)
        return [
            fresh,
            replace(fresh, age=0.5, replica_hosts=("h3",)),
            replace(fresh, age=3600.0, replica_hosts=("h4", "h1", "gone"), size=1 << 30),
            replace(fresh, hosts={"h0": hosts["h0"]}),
        ]

    def test_chooses_hosts_that_are_there(self) -> None:
        """The policy chooses distinct other hosts that exist, and a period above 0 s."""
        for view in self.views():
            self._choice(self.make(), view)

    def test_is_pure(self) -> None:
        """The policy chooses the same for the same view, also as another object."""
        policy, twin = self.make(), self.make()
        for view in self.views():
            first = self._choice(policy, view)
            for again in (self._choice(policy, view), self._choice(twin, view)):
                assert again == first, f"for the same view it chose {first}, then {again}"

    def test_stays_with_its_choice(self) -> None:
        """The policy keeps its hosts once they hold replicas, in any order of the list.

        The list begins with the newest replica, so its order changes from second to second.
        """
        for view in self.views():
            choice = self._choice(self.make(), view)
            if choice is not None:
                for order in islice(permutations(choice.hosts), _ORDERS):
                    replicated = replace(view, age=0.1, replica_hosts=order)
                    again = self._choice(self.make(), replicated)
                    assert again is None or set(again.hosts) == set(choice.hosts), (
                        f"kept on {', '.join(order)} it chooses {', '.join(again.hosts)}"
                    )

    def test_sets_a_pace_for_dumps_of_memory(self) -> None:
        """A policy with a pace returns more than 0 s or None, the same for the same view."""
        policy: object = self.make()
        twin: object = self.make()
        if not (implements(policy, MemoryPacing) and implements(twin, MemoryPacing)):
            return
        for asked in (0.5, 60.0):
            for size, pause in ((0, 0.0), (1 << 30, 8.0)):
                view = MemoryView(self.spec, "h0", asked, size, pause)
                first, *others = (self._pace(one, view) for one in (policy, policy, twin))
                for again in others:
                    assert again == first, f"for the same view the pace was {first}, then {again}"

    def _pace(self, policy: MemoryPacing, view: MemoryView) -> float | None:
        return call("pace", CALL_LIMIT, lambda: sound_pace(policy.pace(view)), policy)
