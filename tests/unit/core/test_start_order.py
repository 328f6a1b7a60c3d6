"""Start order: processes start after their dependencies, and stop before them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rosrm.core.master import events as happened
from rosrm.model.arrays import ArrayMembership
from rosrm.model.orders import RestartInstance, StopInstance
from rosrm.model.requester import Requester
from rosrm.model.schedules import Schedule
from rosrm.model.values import (
    HostLossPolicy,
    InstanceState,
    NeighbourRule,
    ProcessSpec,
    RestartPolicy,
    StartOrder,
    StopPolicy,
)
from tests.unit.core.cluster import Cluster, Machine, job, movable, node, process

HOURLY = Schedule(every=3600.0)


def after(*names: str, delay: float = 0.0, restart: bool = False, **conditions: str) -> StartOrder:
    """Return a start order; `names` must be ready."""
    on_restart = "restart" if restart else "ignore"
    return StartOrder({**dict.fromkeys(names, "ready"), **conditions}, delay, on_restart)


def dependant(name: str, *names: str, **fields: object) -> ProcessSpec:
    return process(name, start_order=after(*names), **fields)


def follower(name: str, *names: str, **fields: object) -> ProcessSpec:
    """Return a process that restarts with its dependencies."""
    return process(name, start_order=after(*names, restart=True), **fields)


def stops(cluster: Cluster) -> list[str]:
    """Return the names of the processes in the order of the first orders to stop them."""
    orders = cluster.orders(StopInstance)
    return list(dict.fromkeys(one.instance.process for one in orders))


# --- conditions -------------------------------------------------------------------------------


def test_a_process_starts_when_its_dependency_is_ready_and_blocks_no_other_until_then() -> None:
    """`ps` and `explain` name what it awaits; one event is recorded."""
    cluster = Cluster("a").with_processes(
        dependant("viewer", "camera"), node("camera"), process("other")
    )
    why = "waits for camera to be ready"
    assert (cluster.phase("viewer"), cluster.phase("camera")) == ("queued", "starting")
    assert cluster.where("other") == ["a"]
    assert cluster["viewer"].reason == cluster.explain("viewer")["reason"] == why
    assert cluster.explain("viewer")["decision"]["kind"] == "fits"
    cluster.wait(1.0)
    assert cluster.recorded("waits") == [f"viewer {why}"]
    cluster.discover("camera")
    assert cluster.phase("viewer") == "running"


def test_a_job_of_an_array_starts_after_its_dependency_too() -> None:
    """It enters the queue only when its array has a place for it."""
    waits = job("j", start_order=after("camera"), array=ArrayMembership("r", 0, 1))
    cluster = Cluster("a").with_processes(node("camera"), waits)
    assert cluster["j"].reason == "waits for camera to be ready"
    cluster.discover("camera")
    assert cluster.phase("j") == "running"


def test_a_process_starts_when_a_job_has_finished() -> None:
    """A job that runs has not finished."""
    cluster = Cluster("a").with_processes(
        job("calibrate"), process("driver", start_order=after(calibrate="finished"))
    )
    assert cluster.phase("calibrate") == "running"
    assert cluster["driver"].reason == "waits for calibrate to finish"
    cluster.finish("calibrate")
    assert cluster.phase("driver") == "running"


def test_a_job_that_has_finished_counts_as_ready() -> None:
    """Its run may be shorter than the time of a report."""
    cluster = Cluster("a").with_processes(job("short"))
    cluster.finish("short")
    assert cluster.submit(dependant("b", "short")).accepted
    assert cluster.phase("b") == "running"


def test_a_process_waits_for_all_dependencies() -> None:
    """The reason names those that are missing."""
    cluster = Cluster("a").with_processes(
        node("camera"), node("lidar"), job("calibrate"),
        process("slam", start_order=after("camera", "lidar", calibrate="finished")),
    )  # fmt: skip
    cluster.discover("camera")
    why = "waits for lidar to be ready and for calibrate to finish"
    assert cluster["slam"].reason == why
    cluster.discover("lidar")
    cluster.finish("calibrate")
    assert cluster.phase("slam") == "running"


def test_the_delay_begins_when_all_conditions_hold() -> None:
    """Conditions that have held for longer cause no delay."""
    cluster = Cluster("a").with_processes(
        node("camera"), process("viewer", start_order=after("camera", delay=2.0))
    )
    cluster.wait(5.0)
    cluster.discover("camera")
    assert cluster["viewer"].reason == "waits for the end of its delay of 2 s after camera"
    cluster.wait(1.5)
    assert cluster.phase("viewer") == "queued"
    cluster.wait(1.0)
    assert cluster.phase("viewer") == "running"
    cluster.submit(process("second", start_order=after("camera", delay=2.0)))
    assert cluster.phase("second") == "running"


def test_a_condition_that_no_longer_holds_when_the_delay_ends_is_awaited_again() -> None:
    """The delay begins again, too."""
    cluster = Cluster("a").with_processes(
        node("camera", restart=RestartPolicy("always")),
        process("viewer", start_order=after("camera", delay=2.0)),
    )
    cluster.discover("camera")
    cluster.wait(1.0)
    cluster.finish("camera", code=1)
    cluster.wait(2.0)
    assert cluster["viewer"].reason == "waits for camera to be ready"
    cluster.discover("camera")
    cluster.wait(1.5)
    assert cluster.phase("viewer") == "queued"
    cluster.wait(1.0)
    assert cluster.phase("viewer") == "running"


def test_a_dependency_that_ends_later_does_not_stop_its_dependant() -> None:
    """The conditions count at the start alone."""
    cluster = Cluster("a").with_processes(process("camera"), dependant("viewer", "camera"))
    cluster.finish("camera", code=1)
    cluster.wait(2.0)
    assert (cluster.phase("camera"), cluster.phase("viewer")) == ("failed", "running")
    assert cluster.runs("viewer") == 0


def test_a_process_that_returns_to_the_queue_waits_again() -> None:
    """Both are lost with their host; the dependency starts first elsewhere."""
    elsewhere = HostLossPolicy("elsewhere")
    cluster = Cluster("a", suspect=1.0, lease=3.0).with_processes(
        dependant("viewer", "camera", host_loss=elsewhere), node("camera", host_loss=elsewhere)
    )
    cluster.discover("camera")
    assert cluster.where("viewer") == ["a"]
    cluster.add("b")
    cluster.cut("a", seconds=5.0)
    machine = cluster.machines["b"]
    assert [one.process for one in machine.programs] == ["camera"]
    assert cluster["viewer"].reason == "waits for camera to be ready"
    cluster.discover("camera", on="b")
    assert cluster.phase("viewer") == "running"


def test_waiting_processes_do_not_hold_back_those_behind_them_that_wait_for_room() -> None:
    """The head of the queue is the first that waits for its placement alone."""
    cluster = Cluster(Machine("a", memory=1000 * 2**20)).with_processes(
        node("camera"), dependant("viewer", "camera"), process("big", memory=5000),
        process("next", memory=6000),
    )  # fmt: skip
    assert "no host may take it" in cluster["big"].reason
    assert cluster.queue() == ["viewer"]
    cluster.submit(process("one", memory=500), process("two", memory=500), process("three"))
    assert "no host can take it now" in cluster.explain("two")["reason"]
    assert "two first" in cluster.explain("three")["reason"]


def test_neighbours_that_wait_for_each_other_by_place_and_by_start_both_start() -> None:
    """The camera wants the viewer's host; the viewer starts after the camera."""
    near = (NeighbourRule("near", ("viewer",)),)
    cluster = Cluster("a", "b").with_processes(
        dependant("viewer", "camera"), process("camera", neighbours=near)
    )
    cluster.wait(1.0)
    assert cluster.where("viewer") == cluster.where("camera") != []


def test_no_room_is_made_for_a_process_that_waits_for_another_one() -> None:
    """The priority of the waiting process makes no difference."""
    cluster = Cluster(
        Machine("a", memory=1000 * 2**20), Machine("b", memory=1000 * 2**20), hysteresis=0.2
    ).with_processes(
        movable("low", memory=400), movable("low2", memory=400), node("camera", memory=10),
        dependant("viewer", "camera", memory=500, priority=5),
    )  # fmt: skip
    cluster.wait(3.0)
    assert cluster.recorded("preempted") == []
    assert cluster.phase("viewer") == "queued"


# --- dependencies without hope ----------------------------------------------------------------


def test_a_process_keeps_waiting_for_a_dependency_that_has_failed_and_says_what_helps() -> None:
    """A restart of the dependency lets it start."""
    cluster = Cluster("a").with_processes(
        job("calibrate"), process("driver", start_order=after(calibrate="finished"))
    )
    cluster.finish("calibrate", code=1)
    assert cluster["driver"].reason == cluster.explain("driver")["reason"]
    assert cluster["driver"].reason == (
        "waits for calibrate to finish; calibrate has failed: `rosrm restart calibrate` starts it "
        "again"
    )
    cluster.wait(2.0)
    assert cluster.phase("driver") == "queued"
    assert cluster.restart("calibrate").accepted
    assert cluster["driver"].reason == "waits for calibrate to finish"
    cluster.finish("calibrate")
    assert cluster.phase("driver") == "running"


def test_a_process_keeps_waiting_for_a_dependency_that_is_cancelled() -> None:
    """A new submission of the dependency lets it start."""
    cluster = Cluster("a").with_processes(node("camera"), dependant("viewer", "camera"))
    cluster.cancel("camera")
    assert "; camera was cancelled: `rosrm restart camera`" in cluster["viewer"].reason
    cluster.submit(process("camera"))
    assert cluster.phase("viewer") == "running"


def test_a_finished_dependency_of_a_process_that_has_not_ended_is_not_forgotten() -> None:
    """Neither beyond `keep_ended` nor by `rosrm prune`: its dependant may return to the queue."""
    cluster = Cluster("a", keep_ended=0).with_processes(job("calibrate"))
    cluster.submit(process("driver", start_order=after(calibrate="finished")))
    cluster.finish("calibrate")
    cluster.wait(1.0)
    assert cluster.phase("calibrate") == "finished"
    assert cluster.ask(happened.PruneRequested).accepted
    refusal = cluster.ask(happened.PruneRequested, ("calibrate",))
    assert refusal.message == (
        "driver starts after calibrate, and has not ended; cancel driver first. Nothing was removed"
    )
    cluster.restart_master()
    cluster.wait(1.0)
    assert "calibrate" in cluster.state.processes
    cluster.cancel("driver")
    cluster.wait(1.0)
    assert not cluster.state.processes


# --- refusals ---------------------------------------------------------------------------------


REFUSED = {
    "an unknown name": (
        [dependant("b", "camra")],
        "b: after: no such process: 'camra'; did you mean 'camera'? (`rosrm ps --all` lists them)",
    ),
    "itself": (
        [dependant("b", "b")], "b: after: b names itself; only other processes are allowed",
    ),
    "a circle": (
        [dependant("x", "y"), dependant("y", "z"), dependant("z", "x")],
        "after: x -> y -> z -> x is a circle, in which each process starts after the next",
    ),
    "a failed one": (
        [dependant("b", "broken")],
        "b: after: broken has failed: `rosrm restart broken` starts it again",
    ),
    "a cancelled one": (
        [dependant("b", "gone")],
        "b: after: gone was cancelled: `rosrm restart gone` starts it again",
    ),
    "the end of a service": (
        [process("b", start_order=after(camera="finished"))],
        "b: after: camera is a service, which does not finish; use `ready` or declare it as a job",
    ),
    "the end of a job with a schedule": (
        [job("tick", schedule=HOURLY), process("b", start_order=after(tick="finished"))],
        "b: after: tick has a schedule, so it never finishes; use `ready`, or remove its schedule",
    ),
    "a service that has ended": (
        [dependant("b", "ended")],
        "b: after: ended has finished: `rosrm restart ended` starts it again",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("specs", "says"), REFUSED.values(), ids=REFUSED)
def test_a_start_order_that_cannot_be_kept_is_refused(specs: list[ProcessSpec], says: str) -> None:
    """Nothing is queued, and the reply says why."""
    names = ("camera", "broken", "gone", "ended")
    cluster = Cluster("a").with_processes(*map(process, names))
    cluster.finish("broken", code=1)
    cluster.finish("ended")
    cluster.cancel("gone")
    reply = cluster.submit(process("p"), *specs)
    assert (reply.accepted, reply.message) == (False, f"{says}. Nothing was queued")
    assert set(cluster.state.processes) == set(names)


NEVER_FINISHES = {
    "a schedule": (job("batch", schedule=HOURLY), "batch has a schedule, so it never finishes"),
    "a service": (process("batch"), "batch is a service, which does not finish"),
}
B_WAITS = process("b", start_order=after(batch="finished"))


@pytest.mark.parametrize(("changed", "why"), NEVER_FINISHES.values(), ids=NEVER_FINISHES)
@pytest.mark.parametrize("how", ["submitted", "applied", "pending"])
def test_a_job_whose_end_a_process_awaits_remains_one_that_ends(
    changed: ProcessSpec, why: str, how: str
) -> None:
    """Its change is refused, until the process that waits has another order or is cancelled."""
    cluster = Cluster("a")
    cluster.apply("work", job("batch")) if how != "submitted" else cluster.submit(job("batch"))
    if how == "pending":  # the change is accepted first, and its stop takes long
        cluster.machines["a"].stubborn.add("batch")
        cluster.apply("work", changed)
        assert why in cluster.submit(B_WAITS).message
        return
    cluster.submit(B_WAITS)
    if how == "submitted":
        cluster.cancel("batch")
    change = (
        (lambda: cluster.submit(changed))
        if how == "submitted"
        else (lambda: cluster.apply("work", changed))
    )
    reply = change()
    assert not reply.accepted
    assert f"b starts once batch has finished, but {why}" in reply.message
    cluster.cancel("b")
    assert change().accepted


def test_both_sides_of_a_wait_can_be_changed_in_one_request() -> None:
    """Two requests may do it, too: the waiting process first, or the job that gets an end."""
    cluster, ready = Cluster("a"), process("b", start_order=after("batch"))
    cluster.apply("work", job("batch"), B_WAITS)
    assert cluster.apply("work", job("batch", schedule=HOURLY), ready).accepted
    cluster.wait(2.0)
    assert cluster.phase("b") == "running"
    cluster = Cluster("a").with_processes()
    cluster.apply("one", job("batch"))
    cluster.apply("two", B_WAITS)
    assert cluster.apply("two", ready).accepted
    assert cluster.apply("one", job("batch", schedule=HOURLY)).accepted
    assert cluster.apply("one", job("batch")).accepted
    assert cluster.apply("two", B_WAITS).accepted


def test_a_wait_for_the_end_of_the_job_of_another_user_holds_back_no_change() -> None:
    """The reason of the waiting process names the change."""
    cluster, user = Cluster("a"), Requester("user:ada")
    cluster.apply("work", job("batch"))
    cluster.ask(happened.SubmissionReceived, (B_WAITS,), user)
    assert cluster.apply("work", job("batch", schedule=HOURLY)).accepted
    cluster.wait(5.0)
    assert "waits for batch to finish; batch has a schedule, so it" in cluster["b"].reason


def test_a_running_process_is_not_stopped_for_a_version_that_waits_for_another_process() -> None:
    """The process runs until the new job of its version has finished."""
    cluster = Cluster("a")
    cluster.apply("work", process("b"))
    cluster.wait(3.0)
    changed = replace(B_WAITS, command=("new",))
    assert cluster.apply("work", changed, job("batch")).accepted
    cluster.wait(3.0)
    assert (cluster.phase("b"), cluster["b"].spec.command) == ("running", process("b").command)
    (task,) = cluster.state.applications["work"].tasks.values()
    assert task.reason == "its new version waits for batch to finish"
    cluster.finish("batch")
    cluster.wait(3.0)
    assert (cluster.phase("b"), cluster["b"].spec.command) == ("running", ("new",))


def test_a_version_in_which_an_awaited_job_never_ends_does_not_return() -> None:
    """A new process waits for the end that the job has only in the failing version."""
    cluster = Cluster("a")
    cluster.apply("work", job("batch", schedule=HOURLY))
    cluster.wait(2.0)
    cluster.apply("work", job("batch"), process("x"), healthy_for=30.0)
    cluster.wait(2.0)
    assert cluster.submit(B_WAITS).accepted
    cluster.finish("x", code=1)
    cluster.wait(2.0)
    (said,) = cluster.recorded("application_failed")
    assert "does not return: b starts once batch has finished, but batch has a schedule" in said


def test_a_circle_through_processes_that_run_is_refused() -> None:
    """A name was submitted again with another start order."""
    cluster = Cluster("a").with_processes(process("a"), dependant("b", "a"))
    cluster.cancel("a")
    reply = cluster.submit(dependant("a", "b"))
    assert not reply.accepted
    assert "a -> b -> a is a circle" in reply.message


def test_a_dependency_that_is_being_cancelled_is_refused() -> None:
    """The reason is not that the name is unknown."""
    cluster = Cluster("a").with_processes(process("camera"))
    cluster.machines["a"].stubborn.add("camera")
    cluster.cancel("camera")
    assert "camera is being cancelled" in cluster.submit(dependant("viewer", "camera")).message


def test_a_restart_of_an_ended_process_is_refused_while_its_dependency_has_ended() -> None:
    """Both can be restarted together."""
    cluster = Cluster("a").with_processes(node("camera"), dependant("viewer", "camera"))
    cluster.cancel("camera", "viewer")
    refusal = cluster.restart("viewer")
    assert refusal.message == (
        "viewer: after: camera was cancelled: `rosrm restart camera` starts it again. "
        "Nothing was restarted"
    )
    assert cluster.restart("viewer", "camera").accepted
    assert cluster["viewer"].reason == "waits for camera to be ready"


# --- restarts of dependencies -----------------------------------------------------------------


def test_a_process_restarts_in_place_once_its_restarted_dependency_is_ready_again() -> None:
    """One that ignores restarts runs on."""
    cluster = Cluster("a").with_processes(
        node("camera", restart=RestartPolicy("always")), follower("viewer", "camera"),
        dependant("logger", "camera"),
    )  # fmt: skip
    cluster.discover("camera")
    cluster.finish("camera", code=1)
    cluster.wait(1.0)
    assert cluster.runs("viewer") == 0
    cluster.discover("camera")
    cluster.wait(3.0)
    assert (cluster.runs("viewer"), cluster.runs("logger")) == (1, 0)
    assert cluster.recorded("dependency_restarted") == [
        "viewer is restarted on a, because a process after which it starts was restarted"
    ]
    assert not cluster["viewer"].restart_due


def test_a_restart_by_a_user_and_a_new_submission_restart_the_dependants_too() -> None:
    """So does a job that has finished again."""
    cluster = Cluster("a").with_processes(
        process("camera"), job("calibrate"),
        process("viewer", start_order=after("camera", calibrate="finished", restart=True)),
    )  # fmt: skip
    cluster.finish("calibrate")
    cluster.restart("camera")
    assert cluster.runs("viewer") == 1
    cluster.cancel("camera")
    cluster.submit(process("camera"))
    assert cluster.runs("viewer") == 2
    cluster.restart("calibrate")
    assert cluster.runs("viewer") == 2
    cluster.finish("calibrate")
    assert cluster.runs("viewer") == 3


def test_a_restart_passes_through_a_chain_of_dependants() -> None:
    """Each restarts once."""
    cluster = Cluster("a").with_processes(
        process("a"), follower("b", "a"), follower("c", "b"), follower("d", "b", "c")
    )
    cluster.restart("a")
    cluster.wait(5.0)
    assert [cluster.runs(name) for name in "abc"] == [1, 1, 1]
    assert cluster.runs("d") in (1, 2)  # once with b, and once with c, if that is later


def test_nothing_restarts_after_a_move_of_a_dependency() -> None:
    """The dependency was not restarted, even if it had been before."""
    cluster = Cluster("a", "b").with_processes(movable("camera"), follower("viewer", "camera"))
    cluster.restart("camera")
    assert cluster.runs("viewer") == 1
    assert cluster.migrate("camera").accepted
    cluster.wait(15.0)
    assert cluster["camera"].migrations == 1
    assert cluster.runs("viewer") == 1


def test_a_dependant_restarts_after_its_dependency_has_started_on_another_host() -> None:
    """The host of the dependency was lost."""
    cluster = Cluster("a", "b", suspect=1.0, lease=3.0).with_processes(
        process("camera", host_loss=HostLossPolicy("elsewhere"), required_labels={})
    )
    (first,) = cluster.where("camera")
    cluster.set_host(first, "cordon")
    cluster.submit(follower("viewer", "camera"))
    cluster.cut(first, seconds=6.0)
    assert cluster.runs("viewer") == 1


def test_a_restart_that_is_due_survives_a_restart_of_the_master_and_a_lost_order() -> None:
    """The order is repeated until the slave has accepted it."""
    cluster = Cluster("a").with_processes(
        node("camera", restart=RestartPolicy("always")), follower("viewer", "camera")
    )
    cluster.discover("camera")
    cluster.finish("camera", code=1)
    cluster.restart_master()
    assert cluster["viewer"].restart_due
    machine = cluster.machines["a"]
    machine.seen_in_graph("camera", cluster.now)
    cluster.tell(machine.status_batches.popleft())
    (lost,) = [one for one in machine.ordered if isinstance(one.order, RestartInstance)]
    machine.ordered.remove(lost)
    cluster.tell(happened.OrderAnswered.missing(lost.order_id))
    cluster.settle()
    assert cluster.runs("viewer") == 1
    assert not cluster["viewer"].restart_due


def test_a_dependant_that_waits_for_its_own_restart_restarts_once() -> None:
    """The end of its dependency ended it, and it is in back-off."""
    cluster = Cluster("a").with_processes(
        node("camera", restart=RestartPolicy("always")), follower("viewer", "camera")
    )
    cluster.discover("camera")
    cluster.finish("camera", code=1)
    cluster.report("a", cluster.machines["a"].slave.statuses()[-1])
    owner = cluster["viewer"].owner
    status = next(
        one for one in cluster.machines["a"].slave.statuses() if one.instance.number == owner
    )
    cluster.report("a", status.__class__(status.instance, InstanceState.BACKOFF))
    assert cluster.phase("viewer") == "backoff"
    cluster.discover("camera")
    assert len(cluster.orders(RestartInstance)) == 1


# --- stops ------------------------------------------------------------------------------------


def chain(**fields: object) -> list[ProcessSpec]:
    return [
        process("camera", **fields), dependant("slam", "camera"),
        dependant("viewer", "slam", "camera"),
    ]  # fmt: skip


def test_one_cancellation_stops_dependants_before_their_dependencies() -> None:
    """Each is ordered to stop when those that start after it have ended."""
    cluster = Cluster("a").with_processes(*chain())
    cluster.machines["a"].stubborn |= {"slam", "viewer"}
    cluster.cancel("camera", "slam", "viewer")
    assert stops(cluster) == ["viewer"]
    assert cluster["camera"].reason == "being cancelled; waits until slam and viewer have ended"
    assert cluster["slam"].reason == "being cancelled; waits until viewer has ended"
    cluster.wait(3.0)
    cluster.let_go("viewer")
    assert stops(cluster) == ["viewer", "slam"]
    assert cluster["camera"].reason == "being cancelled; waits until slam has ended"
    cluster.let_go("slam")
    assert stops(cluster) == ["viewer", "slam", "camera"]
    assert not cluster.where("camera")
    assert cluster.phase("camera") == "cancelled"


def test_a_dependency_that_alone_is_cancelled_stops_at_once() -> None:
    """Its dependants run on."""
    cluster = Cluster("a").with_processes(*chain())
    cluster.cancel("camera")
    assert (cluster.phase("camera"), cluster.phase("slam")) == ("cancelled", "running")


def test_the_order_of_the_stops_survives_a_restart_of_the_master() -> None:
    """Each stop is ordered after the host of the process and of its dependants has reported."""
    cluster = Cluster("a").with_processes(*chain())
    cluster.machines["a"].stubborn |= {"slam", "viewer"}
    cluster.cancel("camera", "slam", "viewer")
    cluster.carried.clear()
    cluster.restart_master()
    assert stops(cluster) == ["viewer"]
    assert cluster["camera"].reason == "being cancelled; waits until slam and viewer have ended"
    cluster.let_go("viewer")
    cluster.restart_master()
    cluster.let_go("slam")
    assert stops(cluster) == ["viewer", "slam", "camera"]


def test_a_dependency_does_not_wait_forever_for_the_end_of_a_dependant() -> None:
    """After a long time-out it is stopped, with a record; the others keep their order."""
    cluster = Cluster("a", "b", suspect=1.0, lease=3.0).with_processes(*chain())
    quick = StopPolicy(0.0, 0.0)
    cluster.submit(process("rviz", start_order=after("viewer"), stop=quick))
    cluster.machines["a"].stubborn |= {"rviz"}
    cluster.machines["b"].stubborn |= {"rviz"}
    cluster.cancel("camera", "slam", "viewer", "rviz")
    for name in "ab":
        cluster.machines[name]._stop = lambda *_: None
    cluster.wait(34.0)
    assert stops(cluster) == ["rviz"]
    cluster.wait(2.0)
    assert stops(cluster)[:2] == ["rviz", "viewer"]
    assert cluster.recorded("dependants_left") == [
        "viewer is stopped before rviz, which did not end in time"
    ]


def test_a_dependant_that_waits_in_the_queue_is_cancelled_at_once() -> None:
    """Its dependency need not wait."""
    cluster = Cluster("a").with_processes(node("camera"), dependant("viewer", "camera"))
    cluster.cancel("camera", "viewer")
    assert (cluster.phase("camera"), cluster.phase("viewer")) == ("cancelled", "cancelled")


def test_a_cancellation_during_a_move_of_a_dependency_keeps_the_order() -> None:
    """The move is undone, and its source stops when the dependant has ended."""
    cluster = Cluster("a", "b").with_processes(
        movable("camera", ros=True), dependant("viewer", "camera")
    )
    cluster.discover("camera", on=cluster.where("camera")[0])
    (there,) = cluster.where("viewer")
    cluster.machines[there].stubborn.add("viewer")
    assert cluster.migrate("camera").accepted
    cluster.cancel("camera", "viewer")
    cluster.wait(3.0)
    assert cluster["camera"].reason == "being cancelled; waits until viewer has ended"
    cluster.let_go("viewer", on=there)
    assert cluster.phase("camera") == "cancelled"


# --- restart of the master, many processes -------------------------------------------------------


def test_the_conditions_survive_a_restart_of_the_master() -> None:
    """A dependency that was ready counts again once it is reported."""
    cluster = Cluster("a", "b").with_processes(
        process("camera"), job("calibrate"), node("lidar"),
        process("slam", start_order=after("camera", "lidar", calibrate="finished")),
    )  # fmt: skip
    cluster.finish("calibrate", on=cluster.where("calibrate")[0])
    cluster.kill_master()
    cluster.tell(happened.TimePassed())
    assert cluster["slam"].reason == (
        "waits for camera to be ready and for lidar to be ready; camera is unreachable; "
        "lidar is unreachable"
    )
    for machine in cluster.machines.values():
        cluster.register(machine)
    assert cluster["slam"].reason == "waits for lidar to be ready"
    cluster.discover("lidar", on=cluster.where("lidar")[0])
    assert cluster.phase("slam") == "running"


def test_a_dependency_that_the_journal_has_lost_is_not_taken_for_finished() -> None:
    """Its dependant waits, and says what helps."""
    cluster = Cluster("a").with_processes(job("calibrate"))
    cluster.finish("calibrate")
    cluster.set_host("a", "cordon")
    cluster.submit(process("driver", start_order=after(calibrate="finished")))
    del cluster.intents["process"]["calibrate"]
    cluster.restart_master()
    cluster.set_host("a", "uncordon")
    cluster.wait(1.0)
    assert cluster["driver"].reason == (
        "waits for calibrate to finish; calibrate does not exist: submit it again"
    )


def test_a_change_of_one_process_reviews_its_dependants_alone(monkeypatch) -> None:
    """A thousand others wait for other processes."""
    from rosrm.core.master import start_order

    cluster = Cluster("a").with_processes(
        node("camera"), node("lidar"), dependant("viewer", "lidar"),
        *(dependant(f"p{i}", "camera") for i in range(1000)),
    )  # fmt: skip
    reviewed = []
    review = start_order._review_waiting
    monkeypatch.setattr(
        start_order, "_review_waiting",
        lambda state, process, now: (reviewed.append(process.name), review(state, process, now)),
    )  # fmt: skip
    cluster.discover("lidar")
    assert set(reviewed) == {"viewer"}
