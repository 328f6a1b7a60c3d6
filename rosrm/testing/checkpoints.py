"""What the master relies on in a checkpoint policy."""

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

#: Orders of the hosts that keep a state, of those that are tried.
_ORDERS: Final = 24


class CheckpointContract:
    """What the master relies on in a checkpoint policy.

    Attributes:
        offer: what is tested.
        options: by name, as cluster.yaml has them; the others have their defaults.
        spec: of a stateful process.
    """

    offer: ClassVar[CheckpointOffer]
    options: ClassVar[Mapping[str, Any]] = EMPTY
    spec: ClassVar[ProcessSpec] = ProcessSpec(
        "p", command=("true",), ros=True, migration=MigrationPolicy("handoff")
    )

    def make(self) -> CheckpointPolicy:
        """A new policy; override it where more is needed."""
        policy: CheckpointPolicy = made("checkpoint", self.offer, self.options)
        return policy

    def _choice(self, policy: CheckpointPolicy, view: CheckpointView) -> CheckpointChoice | None:
        """Return a choice; the limit and the checks are those of the master."""
        return call("choose", CALL_LIMIT, lambda: sound_choice(policy.choose(view), view))

    def views(self) -> Sequence[CheckpointView]:
        """A process on one of five hosts: kept nowhere else yet, kept already, and all alone."""
        hosts = {f"h{n}": {"rack": str(n % 2), "room": "1"} for n in range(5)}
        fresh = CheckpointView(self.spec, "h0", None, 1000, (), hosts)
        return [
            fresh,
            replace(fresh, age=0.5, kept_on=("h3",)),
            replace(fresh, age=3600.0, kept_on=("h4", "h1", "gone"), size=1 << 30),
            replace(fresh, hosts={"h0": hosts["h0"]}),
        ]

    def test_chooses_hosts_that_are_there(self) -> None:
        """Each once, never the process's own; and every so many seconds, more than 0."""
        for view in self.views():
            self._choice(self.make(), view)

    def test_is_pure(self) -> None:
        """The same view gives the same choice, also with another object of the policy."""
        policy, twin = self.make(), self.make()
        for view in self.views():
            first = self._choice(policy, view)
            for again in (self._choice(policy, view), self._choice(twin, view)):
                assert again == first, f"for the same view it chose {first}, then {again}"

    def test_stays_with_its_choice(self) -> None:
        """Once its hosts keep the state, nothing travels to another one.

        In whatever order they are listed: the newest goes first, and that changes by the second.
        """
        for view in self.views():
            choice = self._choice(self.make(), view)
            if choice is not None:
                for order in islice(permutations(choice.hosts), _ORDERS):
                    kept = replace(view, age=0.1, kept_on=order)
                    again = self._choice(self.make(), kept)
                    assert again is None or set(again.hosts) == set(choice.hosts), (
                        f"kept on {', '.join(order)} it chooses {', '.join(again.hosts)}"
                    )

    def test_sets_a_pace_for_dumps_of_memory(self) -> None:
        """Of a policy that does: seconds, more than none, the same for the same view, or none."""
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
        return call("pace", CALL_LIMIT, lambda: sound_pace(policy.pace(view)))
