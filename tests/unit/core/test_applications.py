"""Applications: versions as desired states, replaced process by process, and plans of that."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master.applications.listing import application_rows
from rosrm.core.master.commands import Reply
from rosrm.core.slave import events as slave_events
from rosrm.model.applications import Action, ApplicationRow, Target
from rosrm.model.arrays import ArrayMembership
from rosrm.model.orders import AmendInstance, StartInstance
from rosrm.model.requester import OPERATOR, Requester
from rosrm.model.schedules import Schedule
from rosrm.model.values import (
    Amendment,
    GroupMembership,
    InstanceState,
    InstanceStatus,
    Kind,
    Limits,
    MigrationPolicy,
    ProcessSpec,
    Readiness,
    RestartPolicy,
    StartOrder,
)
from tests.unit.core.cluster import GIB, Cluster, Machine, job, movable, node, process
from tests.unit.core.test_handoffs import stateful

ADA, BOB = Requester("user:ada"), Requester("user:bob")


def actions(reply: Reply) -> dict[str, str]:
    """Return the action on each process in a reply."""
    assert reply.accepted, reply.message
    return {one.process: one.action.value for one in reply.actions}


def program(cluster: Cluster, name: str) -> tuple[str, ...]:
    """Return the command of the only instance of a process that really runs."""
    running = [
        held.assignment.spec.command
        for machine in cluster.machines.values()
        for one, held in machine.programs.items()
        if one.process == name
    ]
    (command,) = running
    return command


def new(spec: ProcessSpec, command: str = "new") -> ProcessSpec:
    """Return another version of a process, which needs a new start."""
    return replace(spec, command=(command,))


def state_of(cluster: Cluster, name: str = "nav") -> tuple[int, list[str]]:
    """Return the desired version of an application, and its open tasks."""
    application = cluster.state.applications[name]
    return application.wanted, list(application.tasks)


def row(cluster: Cluster, name: str = "nav") -> ApplicationRow:
    """Return an application as clients list it."""
    (found,) = [one for one in application_rows(cluster.state) if one.name == name]
    return found


# --- apply ------------------------------------------------------------------------------------


def test_an_application_becomes_equal_to_its_file() -> None:
    """Missing processes start, others stop, the unchanged ones keep their instance."""
    cluster = Cluster("a")
    cluster.apply("nav", process("p"), process("q"))
    cluster.wait(1.0)
    kept = cluster["p"].owner
    reply = cluster.apply("nav", process("p"), process("r"))
    assert actions(reply) == {"q": "stop", "r": "start"}
    assert [one.version for one in reply.actions] == [2, 2]
    cluster.wait(2.0)
    assert [cluster.phase(name) for name in "pqr"] == ["running", "cancelled", "running"]
    assert cluster["p"].owner == kept
    assert state_of(cluster) == (2, [])


def test_an_unchanged_application_gets_no_new_version() -> None:
    """The second apply of the same processes changes nothing."""
    cluster = Cluster("a")
    cluster.apply("nav", process("p"))
    cluster.wait(1.0)
    reply = cluster.apply("nav", process("p"))
    assert reply.message == "nav is at version 1: nothing changes"
    assert state_of(cluster) == (1, [])


@pytest.mark.parametrize(
    "changed",
    [{"priority": 7}, {"required_labels": {}}, {"needs": {"memory": 5.0}}, {"protect": True}],
)
def test_a_change_of_what_only_the_master_reads_restarts_nothing(changed: dict[str, Any]) -> None:
    """The instance stays, and the process has the new values."""
    cluster = Cluster(Machine("a", labels={"arm": "left"}))
    first = process("p", required_labels={"arm": "left"})
    cluster.apply("nav", first)
    owner = cluster["p"].owner
    assert actions(cluster.apply("nav", replace(first, **changed))) == {"p": "change"}
    cluster.wait(1.0)
    assert cluster["p"].owner == owner
    assert cluster["p"].spec == replace(first, application="nav", **changed)
    assert state_of(cluster) == (2, [])


@pytest.mark.parametrize(
    "changed",
    [{"restart": RestartPolicy("always", delay=0.5)}, {"limits": Limits(memory=2e9, cpu=1.0)}],
    ids=str,
)
def test_what_its_slave_can_change_of_a_process_changes_in_place(changed: dict[str, Any]) -> None:
    """The slave changes the running instance, also after a restart of the master.

    The order is lost with the master.
    """
    cluster = Cluster("a")
    cluster.apply("nav", process("p"))
    owner = cluster["p"].owner
    cluster.cut("a")
    assert actions(cluster.apply("nav", process("p", **changed))) == {"p": "change"}
    cluster.reconnect("a")
    cluster.restart_master()
    cluster.wait(3.0)
    (program_of_p,) = cluster.machines["a"].programs.values()
    assert {name: getattr(program_of_p, name) for name in changed} == changed
    assert cluster["p"].owner == owner
    assert state_of(cluster) == (2, [])


def test_limits_that_the_slave_refuses_lead_back() -> None:
    """The process uses more than the new limit; it runs on with the former one."""
    cluster = Cluster(Machine("a", uses=1e9))
    cluster.apply("nav", process("p", limits=Limits(memory=2e9)))
    cluster.wait(1.0)
    owner = cluster["p"].owner
    cluster.apply("nav", process("p", limits=Limits(memory=5e8)))
    cluster.wait(3.0)
    why = "nav returns from version 2 to 1: p: its slave refuses: it uses 1e+09 B already"
    assert why in cluster.recorded("application_returns")
    assert (state_of(cluster), cluster["p"].owner) == ((1, []), owner)
    assert cluster["p"].spec.limits == Limits(memory=2e9)
    assert not cluster.state.unamended


def test_refused_limits_without_a_former_version_degrade_the_application() -> None:
    """The list says what the record says, until the slave accepts the limits."""
    cluster = Cluster(Machine("a", uses=1e9))
    cluster.apply("nav", process("p", limits=Limits(memory=2e9)))
    cluster.apply("nav", process("p", limits=Limits(memory=5e8)))  # version 1 was not reached yet
    cluster.wait(3.0)
    why = "its slave refuses: it uses 1e+09 B already"
    assert cluster.recorded("application_failed") == [f"nav is degraded: p: {why}"]
    assert (row(cluster).state, row(cluster).running) == ("degraded", 0)
    assert row(cluster).reason == f"p is not changed: {why}"
    cluster.machines["a"].uses = 0.0
    cluster.wait(3.0)
    assert (row(cluster).state, row(cluster).reason) == ("running", "")


def test_an_order_has_no_limits_where_only_the_restart_policy_changes() -> None:
    """A supervisor of an earlier version, which cannot change limits, would refuse all of it."""
    cluster = Cluster("a")
    spec = process("p", limits=Limits(memory=2e9))
    cluster.apply("nav", spec)
    cluster.apply("nav", replace(spec, restart=RestartPolicy("always")))
    cluster.wait(1.0)
    (order,) = cluster.orders(AmendInstance)
    assert order.amendment == Amendment(RestartPolicy("always"), limits=None)
    cluster.cut("a")
    for limit, when in ((1e9, "always"), (1e9, "never")):
        policy = RestartPolicy(when)
        cluster.apply("nav", replace(spec, limits=Limits(memory=limit), restart=policy))
        cluster.wait(1.0)
    assert cluster.orders(AmendInstance)[-1].amendment.limits == Limits(memory=1e9)


def test_an_order_is_repeated_without_limits_after_a_restart_of_the_master() -> None:
    """The journal has which parts of the running instance are still to be changed."""
    cluster = Cluster("a")
    spec = process("p", limits=Limits(memory=2e9))
    cluster.apply("nav", spec)
    cluster.cut("a")
    cluster.apply("nav", replace(spec, restart=RestartPolicy("always")))
    cluster.kill_master()
    cluster.rejoin("a", 3.0)
    assert not cluster.state.unamended
    sent = {order.amendment for order in cluster.orders(AmendInstance)}
    assert sent == {Amendment(RestartPolicy("always"), limits=None)}


def test_refused_limits_stay_open_when_the_paused_version_is_applied_again() -> None:
    """The application is not as desired until the slave has changed the process."""
    cluster = Cluster(Machine("a", uses=1e9))
    cluster.apply("nav", process("p", limits=Limits(memory=2e9)))
    cluster.wait(1.0)
    for _ in range(2):
        cluster.apply("nav", process("p", limits=Limits(memory=5e8)), on_failure="pause")
        cluster.wait(3.0)
        assert row(cluster).state == "paused"
    cluster.machines["a"].uses = 0.0
    cluster.apply("nav", process("p", limits=Limits(memory=5e8)), on_failure="pause")
    cluster.wait(3.0)
    assert (row(cluster).state, state_of(cluster)) == ("running", (2, []))


def test_a_change_may_overtake_the_assignment() -> None:
    """The slave does not know the instance yet, which is no fault of the new version."""
    cluster = Cluster("a")
    cluster.apply("nav", process("p"))
    cluster.wait(2.0)
    machine = cluster.machines["a"]
    machine.connected = False
    cluster.apply("nav", process("p"), process("q"))
    late, machine.polled = machine.polled, []
    machine.connected = True
    cluster.apply("nav", process("p"), process("q", restart=RestartPolicy("always")))
    cluster.wait(0.5)
    machine.polled = late
    cluster.wait(5.0)
    assert (cluster.phase("q"), state_of(cluster)) == ("running", (3, []))
    (held,) = [one for key, one in machine.programs.items() if key.process == "q"]
    assert held.restart == RestartPolicy("always")


def test_the_next_version_waits_for_unfinished_work_on_the_one_before() -> None:
    """A process that both versions have, and that does not run yet, is not as desired."""
    cluster = Cluster("a")
    full = process("p", 20_000)
    cluster.apply("nav", full)
    reply = cluster.apply("nav", full, process("q"))
    assert [(one.process, one.version) for one in reply.actions] == [("q", 2)]
    cluster.wait(2.0)
    assert (row(cluster).state, state_of(cluster)) == ("applying", (2, ["p"]))
    cluster.apply("nav", process("q"))
    cluster.wait(2.0)
    assert (row(cluster).state, state_of(cluster)) == ("running", (3, []))


def test_a_process_in_the_queue_gets_its_new_spec() -> None:
    """A waiting process is placed by its new needs, at its place in the queue."""
    cluster = Cluster("a")
    cluster.apply("nav", process("p", 20_000))
    assert cluster.phase("p") in ("queued", "set_aside")
    cluster.apply("nav", process("p", 20))
    cluster.wait(2.0)
    assert (cluster.phase("p"), state_of(cluster)) == ("running", (2, []))


def test_ended_processes_start_again_but_finished_jobs_do_not() -> None:
    """An apply of the same file starts what has failed or was cancelled."""
    cluster = Cluster("a")
    parts = (job("done"), process("failed"), process("cancelled"))
    cluster.apply("nav", *parts)
    cluster.wait(1.0)
    cluster.finish("done")
    cluster.finish("failed", code=3)
    cluster.cancel("cancelled")
    cluster.wait(1.0)
    assert actions(cluster.apply("nav", *parts)) == {"failed": "start", "cancelled": "start"}
    cluster.wait(1.0)
    assert [cluster.phase(one.name) for one in parts] == ["finished", "running", "running"]


def test_a_finished_job_does_not_run_again_for_a_change_in_place() -> None:
    """Nor is there a new start to plan."""
    cluster = Cluster("a")
    cluster.apply("nav", job("done"))
    cluster.finish("done")
    assert actions(cluster.apply("nav", job("done", priority=7))) == {}
    cluster.wait(1.0)
    assert cluster.phase("done") == "finished"


def test_the_number_of_jobs_of_an_array_at_a_time_changes_in_place() -> None:
    """Running jobs run on, and others start up to the new number."""

    def array(parallel: int) -> list[ProcessSpec]:
        members = (ArrayMembership("sweep", index, parallel) for index in range(4))
        return [job(f"sweep_{one.index}", array=one) for one in members]

    cluster = Cluster("a")
    cluster.apply("sweep", *array(1))
    (first,) = [name for name in cluster.state.processes if cluster.where(name)]
    owner = cluster[first].owner
    assert set(actions(cluster.apply("sweep", *array(3))).values()) == {"change"}
    cluster.wait(1.0)
    running = [name for name in cluster.state.processes if cluster.where(name)]
    assert (len(running), cluster[first].owner) == (3, owner)


@pytest.mark.parametrize("remove", ["prune", "collect"])
def test_a_finished_job_stays_as_long_as_its_application_wants_it(remove: str) -> None:
    """Without it, the next apply of the same file would run the job again."""
    cluster = Cluster("a", keep_ended=0)
    cluster.apply("nav", job("done"))
    cluster.finish("done")
    if remove == "prune":
        assert cluster.ask(happened.PruneRequested, (), ()).message == "nothing to remove"
        refusal = cluster.ask(happened.PruneRequested, ("done",), ()).message
        assert "done is a finished job of the application nav, and would run again" in refusal
    cluster.wait(5.0)
    assert actions(cluster.apply("nav", job("done"))) == {}


def test_cancelled_applications_are_pruned() -> None:
    """Their names and versions are free, in the journal too; those of other users stay."""
    cluster = Cluster("a")
    cluster.apply("nav", process("p"), by=ADA)
    cluster.apply("map", process("q"), by=BOB)
    for name, owner in (("nav", ADA), ("map", BOB)):
        cluster.apply(name, by=owner)
    cluster.wait(2.0)
    reply = cluster.ask(happened.PruneRequested, (), (), ADA)
    assert reply.message == "1 process and 1 application removed"
    assert list(cluster.state.applications) == ["map"]
    assert list(cluster.intents["application"]) == ["map"]
    assert list(cluster.intents["version"]) == ["1 map"]


# --- replacement ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "spec",
    [process("p"), movable("p"), movable("p", overlap=False), stateful("p")],
    ids=["without a strategy", "relaunch", "relaunch without overlap", "handoff"],
)
def test_a_changed_program_is_replaced(spec: ProcessSpec) -> None:
    """By every strategy the new program runs, on its host, and there is one instance."""
    cluster = Cluster("a", "b")
    cluster.apply("nav", spec)
    before = cluster.where("p")
    cluster.apply("nav", new(spec))
    cluster.wait(8.0)
    assert program(cluster, "p") == ("new",)
    assert cluster.where("p") == before
    assert state_of(cluster) == (2, [])
    assert cluster["p"].migrations == 0


def test_a_stateful_process_hands_over_its_state_to_the_new_program() -> None:
    """The new instance starts as a shadow with the new spec, and takes over."""
    cluster = Cluster("a")
    cluster.apply("nav", stateful("p"))
    cluster.apply("nav", new(stateful("p")))
    cluster.wait(8.0)
    starts = [one.assignment for one in cluster.orders(StartInstance)]
    assert [(one.shadow, one.spec.command) for one in starts] == [(True, ("new",))]
    assert cluster.recorded("migrated") == ["p was replaced on a by its new version"]
    assert cluster.active("p") == ["a"]


def test_at_most_max_parallel_processes_are_replaced_at_once() -> None:
    """The next one begins when the one before has run well for `healthy_for`."""
    cluster = Cluster("a")
    parts = [movable(name) for name in "pqr"]
    cluster.apply("nav", *parts)
    cluster.wait(1.0)
    cluster.apply("nav", *map(new, parts), healthy_for=5.0)
    cluster.wait(4.0)
    assert [program(cluster, name) for name in "pqr"] == [("new",), ("run", "it"), ("run", "it")]
    cluster.wait(20.0)
    assert [program(cluster, name) for name in "pqr"] == [("new",)] * 3


def test_a_process_in_back_off_waits_for_no_other_replacement() -> None:
    """`max_parallel` counts only processes that run."""
    cluster = Cluster("a")
    parts = [movable(name) for name in "pqr"]
    cluster.apply("nav", *parts)
    cluster.wait(1.0)
    failing = cluster.state.instances[cluster["r"].owner].id
    cluster.report("a", InstanceStatus(failing, InstanceState.BACKOFF))
    cluster.apply("nav", *map(new, parts), healthy_for=5.0)
    cluster.wait(3.0)
    assert [program(cluster, name) for name in "pqr"] == [("new",), ("run", "it"), ("new",)]


def test_a_stateful_process_waits_for_room_and_a_stateless_one_is_stopped_first() -> None:
    """No state is lost if no host has room for both instances."""
    big = 8_000
    cluster = Cluster("a", "b")
    parts = [stateful("p", memory=big), movable("q", memory=big)]
    cluster.apply("nav", *parts)
    cluster.wait(1.0)
    cluster.apply("nav", *map(new, parts), max_parallel=2)
    cluster.wait(10.0)
    assert program(cluster, "q") == ("new",)
    assert program(cluster, "p") == ("run", "it")
    task = cluster.state.applications["nav"].tasks["p"]
    assert "no host has room for the new version of p beside the old" in task.reason


def test_a_degraded_application_is_not_recorded_as_applied() -> None:
    """One process has failed for good when the work on the other one ends."""
    cluster = Cluster("a")
    cluster.apply("nav", process("p", restart=RestartPolicy("never")), process("q"))
    cluster.finish("p", code=1)
    cluster.wait(5.0)
    assert row(cluster).state == "degraded"
    assert cluster.recorded("application_applied") == []
    said = "nav is degraded at version 1: p has failed: exit code 1"
    assert cluster.recorded("application_failed")[-1] == said


def test_the_answer_to_an_apply_that_changes_nothing_says_what_is_not_as_desired() -> None:
    """The version is in force, and its process is out of reach."""
    cluster = Cluster("a", suspect=1.0, lease=3.0)
    cluster.apply("nav", process("p"))
    cluster.wait(1.0)
    assert cluster.apply("nav", process("p")).message == "nav is at version 1: nothing changes"
    cluster.cut("a", seconds=6.0)
    said = "nav is at version 1: nothing changes, but p is unreachable: a is lost"
    assert cluster.apply("nav", process("p")).message == said


def test_a_finished_service_is_not_as_desired() -> None:
    """The application is degraded, and the next apply starts the service again; a job is done."""
    cluster = Cluster("a")
    parts = (process("p", restart=RestartPolicy("never")), job("done"))
    cluster.apply("nav", *parts)
    cluster.wait(1.0)
    cluster.finish("p", code=0)
    cluster.finish("done")
    cluster.wait(1.0)
    (row,) = application_rows(cluster.state)
    assert (row.state, row.running, row.processes) == ("degraded", 1, 2)
    assert row.reason == "p has finished, but is a service: `rosrm apply` starts it again"
    assert actions(cluster.apply("nav", *parts)) == {"p": "start"}


def test_a_new_version_of_a_service_that_finishes_is_given_up() -> None:
    """The service ends within `healthy_for`, although without an error."""
    cluster = Cluster("a")
    spec = movable("p", restart=RestartPolicy("never"))
    cluster.apply("nav", spec)
    cluster.wait(1.0)
    cluster.apply("nav", new(spec), healthy_for=5.0)
    cluster.wait(2.0)
    cluster.finish("p", code=0)
    cluster.wait(10.0)
    assert (program(cluster, "p"), state_of(cluster)) == (("run", "it"), (1, []))
    given_up = cluster.state.applications["nav"].versions[2].given_up
    assert given_up == "p: it has finished, but is a service"


def test_a_new_version_is_not_well_while_its_host_is_silent() -> None:
    """The version crashed during the silence; its host reports that only after `healthy_for`."""
    cluster = Cluster("a")
    spec = movable("p", restart=RestartPolicy("on-failure"))
    cluster.apply("nav", spec)
    cluster.wait(1.0)
    cluster.apply("nav", new(spec), healthy_for=3.0)
    cluster.wait(1.0)
    cluster.machines["a"].connected = False
    cluster.machines["a"].finish("p", cluster.now, code=3)
    cluster.wait(6.0)
    cluster.reconnect("a", seconds=10.0)
    assert (program(cluster, "p"), state_of(cluster)) == (("run", "it"), (1, []))


def test_the_same_request_in_the_middle_changes_nothing() -> None:
    """The new version is watched for `healthy_for` from its start on, and given up if it fails."""
    cluster = Cluster("a")
    cluster.apply("nav", movable("p"))
    cluster.wait(1.0)
    for _ in range(2):
        cluster.apply("nav", new(movable("p")), healthy_for=5.0)
        cluster.wait(2.0)
    cluster.finish("p", code=1)
    cluster.wait(10.0)
    assert (program(cluster, "p"), state_of(cluster)) == (("run", "it"), (1, []))
    assert len(cluster.recorded("application_requested")) == 2


def test_the_same_request_does_not_forget_a_replacement_that_has_begun() -> None:
    """The master also watches the processes that a repeated request replaces."""
    cluster = Cluster("a")
    parts = [movable("p"), movable("q")]
    cluster.apply("nav", *parts)
    cluster.wait(1.0)
    for _ in range(2):
        cluster.apply("nav", *map(new, parts), healthy_for=5.0)
    cluster.wait(2.0)
    cluster.finish("p", code=1)
    cluster.wait(20.0)
    assert [program(cluster, name) for name in "pq"] == [("run", "it")] * 2
    assert state_of(cluster) == (1, [])


@pytest.mark.parametrize("schedule", [Schedule(), Schedule(every=3600.0)], ids=["once", "hourly"])
@pytest.mark.parametrize("policy", [MigrationPolicy(), MigrationPolicy("relaunch")])
def test_a_job_that_completes_during_its_replacement_has_not_failed(
    policy: MigrationPolicy, schedule: Schedule
) -> None:
    """The new version runs once, or at the next run of the schedule; the former one never again."""
    cluster = Cluster("a")
    batch = job("batch", schedule=schedule, migration=policy)
    cluster.apply("nav", batch)
    cluster.wait(3.0)
    target = Target("nav", (replace(new(batch), application="nav"),))
    cluster.ask(happened.ApplicationsRequested, (target,), False, OPERATOR, settle=False)
    cluster.finish("batch")
    cluster.wait(8.0)
    assert (state_of(cluster), cluster.recorded("application_returns")) == ((2, []), [])
    assert cluster["batch"].spec.command == ("new",)
    assert cluster.phase("batch") == ("scheduled" if schedule else "running")


def being_replaced() -> Cluster:
    """Return a cluster with a job on a, whose new version, on b, is not ready yet."""
    cluster, batch = Cluster("a", "b"), node("batch", memory=6000.0, kind=Kind.JOB)
    batch = replace(batch, migration=MigrationPolicy("relaunch"))
    cluster.apply("nav", batch)
    cluster.discover("batch")
    cluster.wait(3.0)
    cluster.apply("nav", new(batch))
    cluster.wait(1.0)
    assert (cluster.phase("batch"), cluster.where("batch")) == ("migrating", ["a", "b"])
    return cluster


def test_a_job_that_completes_while_its_new_version_gets_ready_has_not_failed() -> None:
    """The new version starts once."""
    cluster = being_replaced()
    cluster.finish("batch", "a")
    cluster.wait(1.0)
    cluster.discover("batch", cluster.where("batch")[0])
    cluster.wait(3.0)
    assert (program(cluster, "batch"), state_of(cluster)) == (("new",), (2, []))
    assert cluster.recorded("application_returns") == []


def test_a_job_that_completes_after_its_new_version_has_failed_stays_finished() -> None:
    """The application returns to the former version, whose work is done."""
    cluster = being_replaced()
    cluster.machines["b"].stubborn.add("batch")
    cluster.wait(30.0)
    assert len(cluster.recorded("migration_undone")) == 1
    cluster.finish("batch", "a")
    cluster.let_go("batch", "b")
    cluster.wait(30.0)
    assert (cluster.phase("batch"), cluster.where("batch")) == ("finished", [])
    assert state_of(cluster) == (1, [])


def test_a_user_may_cancel_a_process_while_it_is_replaced() -> None:
    """The process does not start with its new program."""
    cluster = Cluster("a")
    cluster.machines["a"].stubborn.add("p")
    cluster.apply("nav", process("p"))
    cluster.wait(1.0)
    cluster.apply("nav", new(process("p")))
    cluster.cancel("p")
    cluster.let_go("p")
    cluster.wait(5.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("cancelled", [])
    assert state_of(cluster) == (2, [])


@pytest.mark.parametrize("stubborn", [True, False])
def test_a_process_that_was_cancelled_in_the_work_starts_on_the_next_request(
    stubborn: bool,
) -> None:
    """The reply says so, whether its former instance has ended yet or not."""
    cluster = Cluster("a")
    cluster.apply("nav", process("p"))
    cluster.wait(1.0)
    cluster.apply("nav", new(process("p")), healthy_for=10.0)
    cluster.wait(2.0)
    cluster.machines["a"].stubborn |= {"p"} if stubborn else set()
    cluster.cancel("p")
    again = cluster.apply("nav", new(process("p")), healthy_for=10.0)
    if stubborn:
        cluster.let_go("p")
    cluster.wait(15.0)
    assert actions(again) == {"p": "start"}
    assert (program(cluster, "p"), state_of(cluster)) == (("new",), (2, []))


def test_a_process_that_is_cancelled_before_its_replacement_does_not_start_again() -> None:
    """The cancellation is newer than the request whose work on the process has not begun."""
    cluster = Cluster("a")
    parts = [process("p"), process("q")]
    cluster.apply("nav", *parts)
    cluster.wait(1.0)
    cluster.apply("nav", *map(new, parts), healthy_for=5.0, max_parallel=1)
    cluster.wait(1.0)
    cluster.cancel("q")
    cluster.wait(10.0)
    assert (cluster.phase("q"), state_of(cluster)) == ("cancelled", (2, []))


# --- failures ---------------------------------------------------------------------------------


def test_a_version_that_fails_is_given_up() -> None:
    """The processes replaced so far return to the former version; the record says why."""
    cluster = Cluster("a")
    parts = [movable("p"), movable("q")]
    cluster.apply("nav", *parts)
    cluster.wait(1.0)
    cluster.apply("nav", *map(new, parts), healthy_for=5.0)
    cluster.wait(3.0)
    assert program(cluster, "p") == ("new",)
    cluster.finish("p", code=1)
    cluster.wait(10.0)
    assert [program(cluster, name) for name in "pq"] == [("run", "it")] * 2
    assert state_of(cluster) == (1, [])
    (returned,) = cluster.recorded("application_returns")
    assert returned.startswith("nav returns from version 2 to 1: p: it failed")
    given_up = cluster.state.applications["nav"].versions[2].given_up
    warning = f". Warning: version 2 was the same, and given up: {given_up}"
    again = cluster.apply("nav", *map(new, parts), healthy_for=5.0, plan=True)
    assert given_up
    assert again.message.endswith(warning)
    reverted = cluster.apply("nav", version=2)
    assert reverted.message.endswith(warning)


def test_a_return_starts_no_process_that_was_cancelled_since() -> None:
    """The return starts `r`, which the failed version did not have, but not the cancelled `q`."""
    cluster = Cluster("a")
    cluster.apply("nav", process("p"), process("q"), process("r"))
    cluster.wait(1.0)
    cluster.apply("nav", new(process("p")), process("q"), healthy_for=5.0)
    cluster.wait(2.0)
    cluster.cancel("q")
    cluster.finish("p", code=1)
    cluster.wait(10.0)
    assert [cluster.phase(name) for name in "pqr"] == ["running", "cancelled", "running"]
    assert state_of(cluster) == (1, [])


def test_a_return_starts_what_the_failed_version_has_ended() -> None:
    """The failure of a process has cancelled its group, and a job has run for too long."""
    cluster = Cluster("a")
    group = GroupMembership("pair", "on-failure")
    parts = [movable("p", group=group), process("q", group=group), job("r")]
    cluster.apply("nav", *parts)
    cluster.wait(1.0)
    late = replace(new(parts[2]), time_limit=2.0)
    cluster.apply("nav", new(parts[0]), parts[1], late, healthy_for=30.0, max_parallel=3)
    cluster.wait(1.0)
    cluster.finish("p", code=1)
    cluster.wait(10.0)
    assert [program(cluster, name) for name in "pqr"] == [("run", "it")] * 3
    assert state_of(cluster) == (1, [])


@pytest.mark.parametrize("other", ["a single process", "another user's"])
def test_a_return_takes_no_process_of_somebody_else(other: str) -> None:
    """The process waits for the name, which was free for a while, and then uses it."""
    cluster = Cluster("a")
    cluster.apply("nav", process("p"), movable("q"), by=ADA)
    cluster.wait(1.0)
    cluster.apply("nav", new(movable("q")), by=ADA, healthy_for=5.0)
    cluster.wait(3.0)
    assert cluster.phase("p") == "cancelled"
    owner = ADA if other == "a single process" else BOB
    cluster.ask(happened.PruneRequested, ("p",), (), ADA)
    assert cluster.ask(happened.SubmissionReceived, (process("p"),), owner).accepted
    cluster.finish("q", code=1)
    cluster.wait(10.0)
    assert cluster["p"].spec.application == ""
    assert cluster["p"].principal == owner.name
    assert other in cluster.state.applications["nav"].tasks["p"].reason
    cluster.cancel("p")
    cluster.ask(happened.PruneRequested, ("p",), ())
    cluster.wait(3.0)
    assert (cluster["p"].spec.application, cluster.phase("p")) == ("nav", "running")
    assert state_of(cluster) == (1, [])


def test_an_instance_that_never_gets_ready_changes_nothing() -> None:
    """The former instance of a process runs on, and the application returns to its version."""
    cluster = Cluster("a")
    cluster.apply("nav", movable("p"))
    cluster.wait(2.0)
    owner = cluster["p"].owner
    cluster.machines["a"].refuses["p"] = "no such program"
    cluster.apply("nav", new(movable("p")))
    cluster.wait(5.0)
    assert (cluster["p"].owner, state_of(cluster)) == (owner, (1, []))


def test_a_replacement_can_pause_instead() -> None:
    """With `on_failure: pause` no other process is replaced, and none returns."""
    cluster = Cluster("a")
    parts = [movable("p"), movable("q")]
    cluster.apply("nav", *parts)
    cluster.wait(1.0)
    cluster.apply("nav", *map(new, parts), healthy_for=5.0, on_failure="pause")
    cluster.wait(3.0)
    cluster.finish("p", code=1)
    cluster.wait(10.0)
    assert program(cluster, "q") == ("run", "it")
    assert cluster.state.applications["nav"].paused.startswith("p: it failed")


def failed_return() -> Cluster:
    """Return a cluster in which `p` could not be replaced by the version that returns."""
    cluster = Cluster("a")
    cluster.apply("nav", movable("p"))
    cluster.wait(1.0)
    cluster.apply("nav", new(movable("p")), process("q"), healthy_for=5.0)
    cluster.wait(2.0)
    cluster.machines["a"].refuses["p"] = "its file system is full"
    cluster.finish("q", code=1)
    cluster.wait(3.0)
    assert program(cluster, "p") == ("new",)
    assert (row(cluster).state, row(cluster).reason) == (
        "degraded", "p is still of another version",
    )  # fmt: skip
    return cluster


@pytest.mark.parametrize("restarted", [False, True])
def test_a_failed_return_of_a_process_is_tried_again(restarted: bool) -> None:
    """Otherwise the version that was given up would run until the next `apply`."""
    cluster = failed_return()
    if restarted:
        cluster.restart_master()
    del cluster.machines["a"].refuses["p"]
    cluster.wait(120.0)
    assert (program(cluster, "p"), state_of(cluster)) == (("run", "it"), (1, []))
    assert row(cluster).state == "running"


def test_a_return_that_fails_again_and_again_is_tried_less_and_less() -> None:
    """The wait doubles up to ten minutes."""
    cluster = failed_return()
    cluster.wait(1800.0, tick=0.5)
    assert len(cluster.recorded("application_failed")) <= 8
    assert program(cluster, "p") == ("new",)


def test_a_process_that_is_cancelled_after_its_failed_return_does_not_start_again() -> None:
    """The master no longer tries to return a cancelled process to another version."""
    cluster = failed_return()
    cluster.machines["a"].refuses.clear()
    cluster.cancel("p")
    cluster.wait(120.0)
    assert cluster.phase("p") == "cancelled"
    assert not cluster.state.applications["nav"].behind


def test_a_version_of_which_a_process_is_replaced_again_is_one_to_return_to() -> None:
    """A process may run another version because its lost host returned, or its return failed."""
    cluster = Cluster(Machine("a", stubborn={"p"}))
    cluster.apply("nav", process("p"))
    cluster.wait(3.0)
    cluster.state.applications["nav"].reopen("p")
    cluster.apply("nav", process("p"), process("q"), healthy_for=5.0)
    cluster.finish("q", code=1)
    cluster.wait(3.0)
    assert state_of(cluster) == (1, [])


def test_a_first_version_has_nothing_to_return_to() -> None:
    """A process that fails leaves the others running."""
    cluster = Cluster("a")
    cluster.machines["a"].refuses["p"] = "no such program"
    cluster.apply("nav", process("p"), process("q"))
    cluster.wait(5.0)
    assert cluster.phase("q") == "running"
    assert state_of(cluster)[0] == 1


def crowded(**settings: Any) -> Cluster:
    """Return a cluster whose host has room for version 1 of p, but not for version 2 just now."""
    cluster = Cluster("a", **settings).with_processes(process("x", 5_000))
    cluster.apply("nav", process("p", 3_000))
    cluster.wait(1.0)
    return cluster


@pytest.mark.parametrize("on_failure", ["return", "pause"])
def test_a_version_whose_process_finds_no_room_is_given_up_after_a_time(on_failure: str) -> None:
    """The old program runs again, or the application pauses; the record has time and reason."""
    cluster = crowded(progress_deadline=30.0)
    cluster.apply("nav", new(process("p", 8_000)), on_failure=on_failure)
    cluster.wait(25.0)
    follows = "version 1 returns" if on_failure == "return" else "the application is paused"
    assert cluster.phase("p") == "queued"
    assert row(cluster).pending["p"].endswith(f"; if this lasts 30 s, {follows}")
    cluster.wait(10.0)
    kind = "application_returns" if on_failure == "return" else "application_failed"
    (message,) = cluster.recorded(kind)
    assert "p: it has waited 30 s for a host: " in message
    if on_failure == "return":
        assert (program(cluster, "p"), state_of(cluster)) == (("run", "it"), (1, []))
    else:
        assert row(cluster).state == "paused"


def test_a_stateful_process_that_finds_no_room_beside_it_is_given_up_after_a_time() -> None:
    """Its old instance never stopped."""
    cluster = Cluster("a", progress_deadline=30.0)
    cluster.apply("nav", stateful("p", memory=8_000))
    cluster.wait(1.0)
    owner = cluster["p"].owner
    cluster.apply("nav", new(stateful("p", memory=8_000)))
    cluster.wait(35.0)
    assert (cluster["p"].owner, state_of(cluster)) == (owner, (1, []))


@pytest.mark.parametrize(
    "spec",
    [job("q", 8_000), process("q", start_order=StartOrder({"w": "finished"}))],
    ids=["a job", "a process that waits for another one"],
)
def test_what_may_wait_long_ends_no_version(spec: ProcessSpec) -> None:
    """A queue of jobs is meant to be long, and the time of a dependency is its own."""
    cluster = crowded(progress_deadline=5.0)
    cluster.apply("nav", process("p", 3_000), job("w"), spec)
    cluster.wait(20.0)
    assert (row(cluster).state, state_of(cluster)) == ("applying", (2, ["q"]))


def test_without_a_deadline_a_process_waits_for_room() -> None:
    """The new version starts once there is room, however late."""
    cluster = crowded(progress_deadline=0.0)
    cluster.apply("nav", new(process("p", 8_000)))
    cluster.wait(900.0, tick=1.0)
    assert "if this lasts" not in row(cluster).pending["p"]
    cluster.cancel("x")
    cluster.wait(3.0)
    assert (program(cluster, "p"), state_of(cluster)) == (("new",), (2, []))


def test_a_short_wait_for_room_does_not_count_towards_the_next_one() -> None:
    """The deadline is that of one wait."""
    cluster = crowded(progress_deadline=30.0)
    cluster.apply("nav", new(process("p", 8_000)), healthy_for=100.0)
    cluster.wait(20.0)
    cluster.cancel("x")
    cluster.wait(3.0)
    assert program(cluster, "p") == ("new",)
    cluster.leave("a")
    cluster.wait(20.0)
    assert cluster.phase("p") == "queued"
    assert state_of(cluster) == (2, ["p"])


@pytest.mark.parametrize("why", ["set aside", "no room"])
def test_a_first_version_is_degraded_by_a_process_without_a_host(why: str) -> None:
    """`rosrm apply` ends then, and the process still starts once a host may take it."""
    cluster = Cluster(Machine("a", memory=4 * GIB), progress_deadline=30.0)
    cluster.with_processes(process("x", 1_500))
    cluster.apply("nav", process("q"), process("p", 5_000 if why == "set aside" else 2_000))
    cluster.wait(12.0 if why == "set aside" else 31.0)
    assert (row(cluster).state, state_of(cluster)) == ("degraded", (1, []))
    assert ("p is set aside: " if why == "set aside" else "p is queued: ") in row(cluster).reason
    (message,) = cluster.recorded("application_failed")
    assert message.startswith("nav is degraded: p: it ")
    cluster.add(Machine("b"))
    cluster.wait(3.0)
    assert (row(cluster).state, cluster.phase("p")) == ("running", "running")


def test_a_plan_shows_that_a_process_would_wait_and_not_what_follows_later() -> None:
    """Its rounds are farther apart than the deadline."""
    cluster = crowded(progress_deadline=5.0)
    reply = cluster.apply("nav", new(process("p", 8_000)), healthy_for=60.0, plan=True)
    (planned,) = reply.actions
    assert (planned.action, bool(planned.waits)) == (Action.REPLACE, True)
    assert "would return" not in reply.message


# --- versions ---------------------------------------------------------------------------------


def test_an_earlier_version_can_be_applied_again() -> None:
    """A revert makes a new version with the processes of the earlier one."""
    cluster = Cluster("a")
    for command in ("one", "two"):
        cluster.apply("nav", new(movable("p"), command))
        cluster.wait(8.0)
    assert actions(cluster.apply("nav", version=1)) == {"p": "replace"}
    cluster.wait(8.0)
    assert (program(cluster, "p"), state_of(cluster)) == (("one",), (3, []))


def test_old_versions_are_dropped() -> None:
    """The newest `keep_versions` are kept, in the journal too; a dropped one is refused by name."""
    cluster = Cluster("a", keep_versions=2)
    for number in range(4):
        cluster.apply("nav", process("p", priority=number))
        cluster.wait(1.0)
    assert list(cluster.state.applications["nav"].versions) == [3, 4]
    assert sorted(cluster.intents["version"]) == ["3 nav", "4 nav"]
    reply = cluster.apply("nav", version=1)
    assert not reply.accepted
    assert "has no version 1 (any more); kept: 3 and 4" in reply.message


def test_a_cancelled_application_can_be_applied_again() -> None:
    """A request without processes cancels all of them; the versions stay."""
    cluster = Cluster("a")
    cluster.apply("nav", process("p"), process("q"))
    assert actions(cluster.apply("nav")) == {"p": "stop", "q": "stop"}
    cluster.wait(2.0)
    assert [cluster.phase(name) for name in "pq"] == ["cancelled"] * 2
    assert state_of(cluster) == (0, [])
    cluster.apply("nav", version=1)
    cluster.wait(2.0)
    assert [cluster.phase(name) for name in "pq"] == ["running"] * 2


# --- refusals ---------------------------------------------------------------------------------


def test_an_unknown_application_is_refused_with_the_nearest_name() -> None:
    """So is its cancellation; the refusal names the command that lists applications."""
    cluster = Cluster("a")
    cluster.apply("navigation", process("p"))
    reply = cluster.apply("navigatin")
    assert (reply.accepted, reply.code) == (False, "unknown")
    assert "navigation" in reply.message
    assert "`rosrm apps` lists them" in reply.message


def test_a_name_of_another_application_is_refused_as_a_whole() -> None:
    """Nothing of the application starts."""
    cluster = Cluster("a").with_processes(process("single"))
    cluster.apply("map", process("p"))
    for taken, whose in (("p", "of the application map"), ("single", "a single process")):
        reply = cluster.apply("nav", process("q"), process(taken))
        assert (reply.accepted, reply.code) == (False, "name_taken")
        assert f"nav cannot have {taken}, which is {whose} already" in reply.message
    assert "nav" not in cluster.state.applications


@pytest.mark.parametrize("plan", [False, True])
def test_the_refusal_of_a_name_says_how_it_gets_free(plan: bool) -> None:
    """By a change of the other application; a process that is being stopped needs none."""
    cluster = Cluster(Machine("a", stubborn={"q"}))
    cluster.apply("map", process("p"), process("q"))
    reply = cluster.apply("nav", process("p"), plan=plan)
    assert "remove it from the file of map and apply that first" in reply.message
    cluster.apply("map", process("p"))
    reply = cluster.apply("nav", process("q"), plan=plan)
    assert "it is being cancelled: try again once it has ended" in reply.message
    assert "nav" not in cluster.state.applications


def test_one_request_has_each_name_once() -> None:
    """Two files of one application, or two applications with one process: nothing is changed."""
    cluster = Cluster("a")

    def target(application: str, name: str) -> Target:
        return Target(application, (process(name, application=application),))

    for second, why in (
        (target("nav", "q"), "the application nav is given twice: put all its processes into one"),
        (target("map", "p"), "the process p is given twice: names are unique"),
    ):
        targets = (target("nav", "p"), second)
        reply = cluster.ask(happened.ApplicationsRequested, targets, False)
        assert (reply.accepted, reply.code) == (False, "name_taken")
        assert reply.message.startswith(why)
    assert not cluster.state.applications
    assert not cluster.state.processes


@pytest.mark.parametrize("kept", ["in its own application", "alone"])
def test_a_dependency_on_what_is_cancelled_is_refused(kept: str) -> None:
    """The file is refused as a whole, so the processes before run on."""
    cluster = Cluster("a")
    cluster.apply("nav", process("p"))
    cluster.with_processes(process("single"))
    cluster.wait(1.0)
    name = "p" if kept == "in its own application" else "single"
    if name == "single":
        cluster.machines["a"].stubborn.add("single")
        cluster.cancel("single")
    late = process("q", start_order=StartOrder({name: "ready"}))
    reply = cluster.apply("nav", *[process("p")] * (name == "single"), late)
    assert (reply.accepted, state_of(cluster)) == (False, (1, []))
    why = "no longer a process of its application" if name == "p" else "is being cancelled"
    assert f"q: after: {name}" in reply.message
    assert why in reply.message
    assert cluster.phase("p") == "running"


def test_an_operator_gives_no_process_of_one_user_to_the_application_of_another() -> None:
    """The refusal names the owner, and the command that frees the name of an ended process."""
    cluster = Cluster("a")
    cluster.apply("nav", process("p"), by=ADA)
    cluster.ask(happened.SubmissionReceived, (process("q"),), BOB)
    reply = cluster.apply("nav", process("p"), process("q"))
    assert "nav cannot have q, which is a process of user:bob already" in reply.message
    cluster.cancel("q")
    reply = cluster.apply("nav", process("p"), process("q"))
    assert "it has ended, and `rosrm prune q` removes it" in reply.message
    cluster.ask(happened.PruneRequested, ("q",), ())
    assert cluster.apply("nav", process("p"), process("q")).accepted


def test_a_process_starts_after_the_end_of_an_instance_that_no_process_owns() -> None:
    """No name has two instances, also where the journal was lost with the process."""
    cluster = Cluster(Machine("a", stubborn={"p"})).with_processes(process("p"))
    cluster.kill_master()
    cluster.intents["process"].clear()
    cluster.restart_master()
    cluster.apply("nav", process("p"))
    cluster.wait(3.0)
    assert cluster.where("p") == ["a"]
    assert row(cluster).pending == {"p": "waits until p#1 on a has ended"}
    cluster.let_go("p")
    cluster.wait(3.0)
    assert (cluster.where("p"), row(cluster).state) == (["a"], "running")


def test_a_process_of_an_application_is_not_submitted() -> None:
    """The refusal names the command."""
    cluster = Cluster("a")
    reply = cluster.submit(replace(process("p"), application="nav"))
    assert not reply.accepted
    assert "use `rosrm apply FILE`" in reply.message


def test_an_application_of_another_user_is_refused() -> None:
    """Only its owner and operators change an application."""
    cluster = Cluster("a")
    assert cluster.apply("nav", process("p"), by=ADA).accepted
    reply = cluster.apply("nav", by=BOB)
    assert (reply.accepted, reply.code) == (False, "denied")


def test_the_quota_of_an_application_is_its_owners() -> None:
    """Also where an operator applies it."""
    cluster = Cluster("a", quotas={ADA.name: {"processes": 1}})
    cluster.apply("nav", process("p"), by=ADA)
    reply = cluster.apply("nav", process("p"), process("q"))
    assert (reply.accepted, reply.code) == (False, "quota")
    assert "user:ada would exceed its quota" in reply.message


def test_a_gang_of_an_application_is_its_owners() -> None:
    """A gang that waits already is found also where an operator applies the application."""
    cluster = Cluster("a")
    huge = process("p", 20_000, together="pair"), process("q", 20, together="pair")
    cluster.apply("nav", *huge, by=ADA)
    reply = cluster.apply("nav", *huge, process("r", together="pair"))
    assert (reply.accepted, reply.code) == (False, "name_taken")


# --- a master that is killed ------------------------------------------------------------------


@pytest.mark.parametrize("killed_after", range(0, 60, 3))
def test_a_killed_master_goes_on_with_the_replacement(killed_after: int) -> None:
    """At each moment of an apply: the new version is reached, and each process runs once."""
    cluster = Cluster("a", "b")
    parts = [stateful("p"), movable("q"), process("r"), process("gone")]
    cluster.apply("nav", *parts)
    cluster.wait(1.0)
    cluster.apply("nav", *map(new, parts[:3]), process("added"))
    cluster.wait(killed_after * 0.1)
    cluster.restart_master()
    cluster.wait(25.0)
    assert [program(cluster, name) for name in "pqr"] == [("new",)] * 3
    assert (cluster.where("gone"), len(cluster.where("added"))) == ([], 1)
    assert state_of(cluster) == (2, [])


def test_an_application_is_judged_once_its_hosts_have_reported_again() -> None:
    """After a restart of the master it is not degraded until a host reports, or its lease ends."""
    cluster = Cluster("a", "b").with_processes(process("filler"))
    cluster.apply("nav", process("p"))
    cluster.wait(1.0)
    (host,) = cluster.where("p")
    (other,) = {"a", "b"} - {host}
    cluster.kill_master()
    cluster.rejoin(other)
    assert (row(cluster).state, row(cluster).pending) == (
        "applying", {"p": f"{host} has not reported since the master started"},
    )  # fmt: skip
    cluster.rejoin(host)
    assert (row(cluster).state, row(cluster).pending) == ("running", {})
    cluster.kill_master()
    cluster.cut(host)
    cluster.rejoin(other, 30.0)
    assert (row(cluster).state, row(cluster).reason) == (
        "degraded",
        f"p is unreachable: {host} is lost",
    )


def test_a_process_that_its_application_has_no_more_is_not_restarted() -> None:
    """The process would run beside the version in force. A revert starts it again."""
    cluster = Cluster("a")
    cluster.apply("nav", process("p"), process("q"))
    cluster.apply("nav", process("p"))
    cluster.wait(1.0)
    assert cluster.restart("q").message == (
        "q is not in version 2 of nav: apply a version that has it. Nothing was restarted"
    )
    cluster.ask(happened.ApplicationsRequested, (Target("nav"),), False)
    cluster.wait(1.0)
    assert cluster.restart("p").message == (
        "p is of nav, which is cancelled: `rosrm revert nav` starts it. Nothing was restarted"
    )
    cluster.ask(happened.ApplicationsRequested, (Target("nav", version=1),), False)
    cluster.wait(1.0)
    assert [cluster.phase(name) for name in "pq"] == ["running", "running"]


def test_an_application_is_degraded_while_an_old_program_runs_in_it() -> None:
    """The version before was not reached, so a failure of the new one leads back to none."""
    cluster = Cluster("a")
    waiting = process("q", required_labels={"arm": "left"})
    cluster.apply("nav", process("p"), waiting)
    cluster.apply("nav", new(process("p", needs={"memory": 1e15})))
    cluster.wait(5.0)
    assert (state_of(cluster), program(cluster, "p")) == ((2, []), process("p").command)
    found = row(cluster)
    assert (found.state, found.running, found.reason) == (
        "degraded", 0, "p is still of another version",
    )  # fmt: skip


def test_an_application_is_not_degraded_while_a_process_of_it_moves() -> None:
    """A process that moves to another host runs."""
    cluster = Cluster("a")
    cluster.apply("nav", movable("p", ros=True, readiness=Readiness(timeout=20.0)))
    cluster.discover("p")
    cluster.wait(1.0)
    cluster.add(Machine("b"))
    assert cluster.migrate("p").accepted
    assert (cluster.phase("p"), row(cluster).state) == ("migrating", "running")


# --- plans ------------------------------------------------------------------------------------


def test_a_plan_names_each_action_with_its_host_and_changes_nothing() -> None:
    """The apply that follows does what the plan says."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5, "cpu": 0.1}))
    parts = [stateful("p"), movable("q"), process("gone"), process("same")]
    cluster.apply("nav", *parts)
    cluster.wait(1.0)
    before = dict(cluster.intents["process"])
    wanted = (*map(new, parts[:2]), parts[3], process("added"), process("huge", 20_000))
    planned = cluster.apply("nav", *wanted, plan=True)
    assert actions(planned) == {
        "p": "replace", "q": "replace", "gone": "stop", "added": "start", "huge": "start",
    }  # fmt: skip
    assert cluster.intents["process"] == before
    assert list(cluster.state.applications["nav"].versions) == [1]
    waits = {one.process: one.waits for one in planned.actions if one.waits}
    assert list(waits) == ["huge"]
    cluster.apply("nav", *wanted)
    cluster.wait(20.0)
    hosts = {one.process: one.host for one in planned.actions if one.host}
    assert {name: cluster.where(name) for name in hosts} == {
        name: [host] for name, host in hosts.items()
    }


def test_a_plan_shows_a_return_to_the_former_version() -> None:
    """The master does not stop an old version if the new version can never run."""
    cluster = Cluster("a")
    cluster.apply("nav", movable("p"))
    cluster.wait(2.0)
    owner, never = cluster["p"].owner, new(movable("p", needs={"gpu": 1.0}))
    cluster.apply("nav", never)
    cluster.wait(2.0)
    assert (cluster["p"].owner, state_of(cluster)) == (owner, (1, []))
    planned = cluster.apply("nav", replace(never, arguments=("again",)), plan=True)
    assert "nav would return to version 1: p: no host may take its new version" in planned.message


def test_a_plan_says_that_a_host_may_refuse_lower_limits() -> None:
    """A plan assumes that each order is carried out; the usage lets the user judge."""
    cluster = Cluster(Machine("a", uses=1e9))
    cluster.machines["a"].shown["p"] = {"memory": 1e9}
    cluster.apply("nav", process("p", limits=Limits(memory=2e9, cpu=1.0)))
    cluster.wait(1.0)
    reasons = []
    for limits in (Limits(memory=5e8, cpu=1.0), Limits(memory=2e9, cpu=2.0)):
        (planned,) = cluster.apply("nav", process("p", limits=limits), plan=True).actions
        reasons.append(planned.reason)
    assert reasons == ["its host refuses a memory limit below the usage, 1.0 GB now", ""]


def test_a_plan_shows_what_waits_for_room() -> None:
    """A stateful process without room for its successor is not replaced in the plan either."""
    cluster = Cluster("a")
    cluster.apply("nav", stateful("p", memory=8_000))
    planned = cluster.apply("nav", new(stateful("p", memory=8_000)), plan=True)
    (action,) = planned.actions
    assert (action.action, action.host) == (Action.REPLACE, "a")
    assert "no host has room" in action.waits


def test_a_plan_moves_with_a_change_of_its_strategy() -> None:
    """A change of the strategy alone is made in place."""
    cluster = Cluster("a")
    cluster.apply("nav", process("p"))
    planned = cluster.apply("nav", process("p", migration=MigrationPolicy("relaunch")), plan=True)
    assert actions(planned) == {"p": "change"}


def test_a_plan_leaves_out_what_others_wait_for() -> None:
    """A process that waits anyway is no difference that the request makes."""
    cluster = Cluster("a").with_processes(process("huge", 20_000))
    cluster.apply("other", process("large", 30_000), by=BOB)
    assert actions(cluster.apply("nav", process("p"), plan=True, by=ADA)) == {"p": "start"}


def test_a_plan_writes_no_history() -> None:
    """`explain` shows what happened, not what would."""
    cluster = Cluster("a")
    cluster.apply("nav", process("p"))
    before = list(cluster["p"].history)
    cluster.apply("nav", new(process("p")), plan=True)
    assert cluster["p"].history == before


class Fetching(Machine):
    """A host on which a start waits for artifacts until the test lets it begin."""

    def _launch(self, assignment, now: float) -> None:
        self.fetches = assignment
        self.tell(slave_events.StartDelayed(assignment.instance, "fetches artifacts"), now)

    def arrive(self, now: float) -> None:
        super()._launch(self.fetches, now)


@pytest.mark.parametrize("hosts", ["a", "ab"])
def test_a_change_in_place_reaches_a_start_that_waits_for_files(hosts) -> None:
    """The fetch continues, and the process starts with the new policy."""
    cluster = Cluster(*(Fetching(host) for host in hosts))
    cluster.apply("app", process("p"))
    (instance,) = cluster["p"].instances
    cluster.apply("app", process("p", restart=RestartPolicy("on-failure")))
    cluster.wait(2.0)
    assert cluster["p"].instances == {instance}
    assert not cluster["p"].excluded
    assert not cluster.state.unamended
    machine = next(one for one in cluster.machines.values() if hasattr(one, "fetches"))
    machine.arrive(cluster.now)
    cluster.wait(1.0)
    (program,) = machine.programs.values()
    assert (cluster.phase("p"), program.restart.when) == ("running", "on-failure")
