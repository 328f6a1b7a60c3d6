"""Contract of migration strategies with the master."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from itertools import takewhile
from math import inf
from pathlib import Path
from typing import Any, ClassVar, Final, get_type_hints

from rosrm.extensions.contracts import (
    Imaging,
    MigrationOffer,
    MigrationStrategy,
    PeriodicImaging,
    SpecChecking,
)
from rosrm.extensions.discovery import definition
from rosrm.extensions.options import merged_options
from rosrm.extensions.plugin_calls import implements, required
from rosrm.extensions.time_limit import CALL_LIMIT
from rosrm.model.codec import checked, to_plain
from rosrm.model.plan import (
    Aim,
    Commit,
    Configure,
    Execute,
    HandoffPhase,
    Move,
    Plan,
    SetRestart,
    Start,
    Step,
    Stop,
)
from rosrm.model.plan import plan_fault as fault_of
from rosrm.model.values import EMPTY, InstanceId, ProcessSpec
from rosrm.testing.calls import ContractBroken, as_json, call, checked_options, made

#: Unit for each kind of quantity of an option.
_UNITS: Final = {"duration": "s", "size": "B", "cores": "cores"}


def with_options(move: Move, offer: MigrationOffer, **cluster: Any) -> Move:
    """Return a move with the merged options, as the master passes it to the strategy.

    Args:
        move: of a process that may have options of its own, as text or numbers.
        offer: of the strategy.
        cluster: the strategy's options for all processes, by name, as in cluster.yaml.
    """
    migration, wanted = move.spec.migration, offer.own_options or offer.options
    own = migration.options if migration.strategy in (None, offer.name) else EMPTY
    given = checked_options(offer.options, cluster)
    return replace(move, options=merged_options(wanted, given, own))


class MigrationContract:
    """Contract of a migration strategy with the master.

    Attributes:
        offer: the tested offer.
        options: by name, as in cluster.yaml; the others have their defaults.
        spec: of a process that the strategy can migrate.
        not_called: executors that a test cannot call, by name, with the reason.
    """

    offer: ClassVar[MigrationOffer]
    options: ClassVar[Mapping[str, Any]] = EMPTY
    spec: ClassVar[ProcessSpec] = ProcessSpec("p", command=("true",))
    not_called: ClassVar[Mapping[str, str]] = EMPTY

    def make(self) -> MigrationStrategy:
        """Return a new strategy; override this if the strategy needs more."""
        strategy: MigrationStrategy = made("migration", self.offer, self.options)
        return strategy

    def _plan(self, strategy: MigrationStrategy, move: Move) -> Plan:
        return _plan("propose", partial(strategy.propose, move), strategy)

    def moves(self) -> Sequence[Move]:
        """Return one move of a process with `overlap: true`, and one with `overlap: false`."""
        move = Move(
            spec=self.spec,
            source=InstanceId(self.spec.name, 1),
            source_host="a",
            destination=InstanceId(self.spec.name, 2),
            destination_host="b",
            fallback=InstanceId(self.spec.name, 3),
            now=1_700_000_000,
            source_node=self.spec.node,
        )
        policies = [replace(self.spec.migration, overlap=overlap) for overlap in (True, False)]
        moves = [replace(move, spec=replace(self.spec, migration=policy)) for policy in policies]
        return [self.with_options(move) for move in moves]

    def with_options(self, move: Move) -> Move:
        """Return a move with its options, as the master passes it."""
        return with_options(move, self.offer, **self.options)

    def test_accepts_its_process(self) -> None:
        """The check of a submitted process, if there is one, returns a text: "" for `spec`."""
        strategy: object = self.make()
        if not implements(strategy, SpecChecking):
            return
        ask = partial(strategy.spec_fault, self.spec)
        fault = call("spec_fault", CALL_LIMIT, lambda: required(ask(), str), strategy)
        assert not fault, f"spec_fault refuses the `spec` of the test class: {fault}"

    def test_plan_is_sound(self) -> None:
        """Each plan has one commit, uses only hosts of its move, and a time-out for every wait."""
        for move in self.moves():
            fault = fault_of(self._plan(self.make(), move), move)
            assert not fault, f"the plan is unsound: {fault}"

    def test_checkpoints_and_restores_are_sound(self) -> None:
        """Plans for checkpoint and restore use one host, and the image owns the process in between.

        The test applies to strategies that implement `Imaging`.
        """
        strategy: object = self.make()
        if not implements(strategy, Imaging):
            return
        for move in self.moves():
            here = replace(move, destination_host=move.source_host)
            for hook, make, aim in (
                ("checkpoint", strategy.checkpoint, Aim.CHECKPOINT),
                ("restore", strategy.restore, Aim.RESTORE),
            ):
                plan = _plan(hook, partial(make, here), strategy)
                fault = fault_of(plan, here, aim)
                assert not fault, f"the plan of {hook} is unsound: {fault}"
                again = _plan(hook, partial(make, here), strategy)
                assert again == plan, f"{hook} gave another plan for the same move"
                assert checked(plan, Plan, "plan") == plan, (
                    f"the journal changes the plan of {hook}"
                )

    def test_periodic_checkpoints_are_sound(self) -> None:
        """Each periodic checkpoint is a step on the instance's host, distinct for each time.

        The test applies to strategies that implement `PeriodicImaging`.
        """
        strategy: object = self.make()
        if not implements(strategy, PeriodicImaging):
            return
        every = call("checkpoint_every", CALL_LIMIT, partial(strategy.checkpoint_every, self.spec))
        assert every >= 0.0, f"checkpoint_every answered {every}; allowed: 0 or more seconds"
        instance = InstanceId(self.spec.name, 1)

        def periodic(now: int) -> Execute:
            step = partial(strategy.periodic, self.spec, instance, "a", now)
            return call("periodic", CALL_LIMIT, lambda: required(step(), Execute), strategy)

        first, again, later = periodic(1), periodic(1), periodic(2)
        assert first == again, "periodic gave another step for the same time"
        assert first != later, "periodic gave the same step for another time"
        for step in (first, later):
            self._check_executor(step)
            assert step.host == "a", (
                f"periodic names the host {step.host!r}; the instance is on 'a'"
            )
            assert step.undo is None, "the step of periodic has an undo, which is never run"
            assert 0.0 < step.timeout < inf, f"the timeout of periodic is {step.timeout} s"

    def test_is_pure(self) -> None:
        """The strategy returns the same plan for the same move, also as another object."""
        strategy, twin = self.make(), self.make()
        for move in self.moves():
            plan = self._plan(strategy, move)
            for one, whose in ((strategy, "the same object"), (twin, "another object")):
                assert self._plan(one, move) == plan, f"{whose} gave another plan for the same move"

    def test_can_be_undone_before_the_commit(self) -> None:
        """Before the commit, a start of the destination and a stop of the source have an undo."""
        for move in self.moves():
            for step in before_commit(self._plan(self.make(), move)):
                if isinstance(step, Start) and step.instance == move.destination:
                    assert isinstance(step.undo, (Stop, Execute)), "the start has no way back"
                if isinstance(step, Stop) and step.instance == move.source:
                    assert isinstance(step.undo, (Start, Execute)), "the stop has no way back"

    def test_numbers_are_used_once(self) -> None:
        """A source that is started again has the number reserved for it, not its old one."""
        for move in self.moves():
            for step in self._plan(self.make(), move).steps:
                if isinstance(step, Stop) and isinstance(step.undo, Start):
                    number = step.undo.instance
                    assert number == move.fallback, (
                        f"the source starts again as {number}; required: move.fallback"
                    )

    def test_an_overlap_is_declared(self) -> None:
        """A plan declares its overlap if a destination of the same name starts before the stop."""
        for move in self.moves():
            plan = self._plan(self.make(), move)
            stopped = False
            for step in plan.steps:
                stopped = stopped or isinstance(step, Execute)  # may stop the source
                if isinstance(step, Stop) and step.instance == move.source:
                    stopped = True
                if isinstance(step, Start) and step.instance == move.destination and not stopped:
                    same_name = step.node_name in ("", move.spec.node) and not step.inactive
                    assert plan.overlap > 0 or not same_name, (
                        "the destination starts before the source has stopped, and the plan "
                        "declares no overlap"
                    )
                    assert move.spec.migration.overlap or not same_name, (
                        "the destination starts before the source has stopped, and the process "
                        "has `overlap: false`"
                    )

    def test_survives_the_journal(self) -> None:
        """A restarted master reads the identical plan from its journal."""
        for move in self.moves():
            plan = self._plan(self.make(), move)
            assert checked(plan, Plan, "plan") == plan, "the journal gives back another plan"

    def test_a_shadow_is_released_after_the_commit(self) -> None:
        """A shadow gets the restart policy of its spec after the commit, and not before.

        The same holds for a destination that is restored from a checkpoint image.
        """
        for move in self.moves():
            plan = self._plan(self.make(), move)
            commit = len(before_commit(plan))
            given = [
                at > commit and step.restart == move.spec.restart
                for at, step in enumerate(plan.steps)
                if isinstance(step, SetRestart) and step.instance == move.destination
            ]
            assert given == [True] * len(shadows(plan)), (
                "each start of a destination in silence needs one SetRestart of the destination "
                "after the Commit, with the restart policy of the spec"
            )

    def test_a_source_that_is_not_restarted_for_a_while_is_again_if_it_stays(self) -> None:
        """The undo of a suspended restart policy sets the policy of the spec again."""
        for move in self.moves():
            for step in before_commit(self._plan(self.make(), move)):
                if isinstance(step, SetRestart):
                    undo = step.undo
                    given = (undo.instance, undo.restart) if isinstance(undo, SetRestart) else None
                    assert given == (step.instance, move.spec.restart), (
                        "a SetRestart before the Commit needs an undo with the policy of the spec"
                    )

    def test_a_silent_source_resumes_only_when_its_successor_has_given_up(self) -> None:
        """The undo of SWITCH is ABORT, and an earlier SHADOW has the undo RESUME."""
        for move in self.moves():
            undone_by = {
                step.phase: step.undo.phase
                for step in before_commit(self._plan(self.make(), move))
                if isinstance(step, Configure) and isinstance(step.undo, Configure)
            }
            if HandoffPhase.SWITCH in undone_by:
                assert list(undone_by.items()) == [
                    (HandoffPhase.SHADOW, HandoffPhase.RESUME),
                    (HandoffPhase.SWITCH, HandoffPhase.ABORT),
                ], "SWITCH needs the undo ABORT, and before it a SHADOW with the undo RESUME"

    def test_executors_are_its_own(self) -> None:
        """Each open step names an executor of the same offer, with JSON arguments."""
        for move in self.moves():
            for step in self._plan(self.make(), move).steps:
                if isinstance(step, Execute):
                    self._check_executor(step)

    def _check_executor(self, step: Execute) -> None:
        own = self.offer.executors
        assert step.executor in own, (
            f"a step names the executor {step.executor!r}; those of the offer: "
            f"{', '.join(sorted(own)) or 'none'}"
        )
        as_json(f"the step of the executor {step.executor!r} has the arguments", step.arguments)

    def test_executors_answer_with_json_objects(self, tmp_path: Path) -> None:
        """Each executor of a plan returns a JSON object within the `timeout` of its step.

        An executor may raise, which is a failed step. Executors in `not_called` are skipped.
        """
        for move in self.moves():
            results: dict[str, Any] = {}
            for step in self._plan(self.make(), move).steps:
                if not isinstance(step, Execute) or step.executor in self.not_called:
                    continue
                pids = {str(move.source): os.getpid()}
                here = {
                    "host": step.host, "state": str(tmp_path), "pids": pids,
                    "instances": list(pids), "options": to_plain(self.offer.host_options()),
                }  # fmt: skip
                self._check_executor(step)
                given = json.loads(json.dumps({**step.arguments, "results": results, "here": here}))
                who, execute = (
                    f"the executor {step.executor!r}",
                    self.offer.executors[step.executor],
                )
                try:
                    answer = call(who, step.timeout, partial(execute, given))
                except ContractBroken:
                    raise
                except Exception:  # noqa: BLE001, S112 - an executor may fail its step by raising
                    continue
                place = definition(self.offer.executors[step.executor])
                results[step.executor] = as_json(f"{who} ({place}) answered", answer)

    def test_options_of_a_process_are_read_from_the_move(self) -> None:
        """The plan is the same if a work file gives the same quantities with units.

        `spec.migration.options` has them as text; `move.options` has them parsed.
        """
        wanted = self.offer.own_options or self.offer.options
        for move in self.moves():
            text = dict(quantities_as_text(move.options if move.options is not None else wanted()))
            policy = replace(move.spec.migration, options={**move.spec.migration.options, **text})
            written = self.with_options(replace(move, spec=replace(move.spec, migration=policy)))
            assert written.options == move.options, (
                f"written {text}, the options are {written.options}, not {move.options}"
            )
            plan = self._plan(self.make(), move)
            assert self._plan(self.make(), written) == plan, (
                f"the plan is another one where the process's own options are written {text}"
            )


def quantities_as_text(options: Any) -> Iterator[tuple[str, str]]:
    """Yield the options that are quantities, each as text with its unit, e.g. "2.0s"."""
    hints = get_type_hints(type(options), include_extras=True)
    for f in fields(options):
        for mark in getattr(hints[f.name], "__metadata__", ()):
            unit = _UNITS.get(getattr(mark, "measures", ""))
            if unit is not None:
                yield f.name, f"{getattr(options, f.name)!r}{unit}"


def shadows(plan: Plan) -> Sequence[Start]:
    """Return the steps that start a destination without output: as a shadow, or restored."""
    starts = [step for step in plan.steps if isinstance(step, Start)]
    return [step for step in starts if step.shadow or step.restored]


def before_commit(plan: Plan) -> Sequence[Step]:
    """Return the steps before the commit; all steps if the plan has none."""
    return list(takewhile(lambda step: not isinstance(step, Commit), plan.steps))


def _plan(hook: str, ask: Callable[[], Plan], strategy: object) -> Plan:
    """Return a plan, with the time limit and checks of the master."""

    def sound() -> Plan:
        plan = required(ask(), Plan)
        checked(plan, Plan, "plan")
        return plan

    return call(hook, CALL_LIMIT, sound, strategy)
