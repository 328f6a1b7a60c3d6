"""Checkpoint and restore: ownership of the name, refusals, and no loss of memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Command, SendOrder
from rosrm.model.orders import AmendInstance, FenceInstance, StartInstance, StopInstance
from rosrm.model.plan import Aim, Commit, Execute, Move, Plan, Start, Stop, plan_fault
from rosrm.model.requester import Requester
from rosrm.model.values import (
    HostLossPolicy,
    InstanceId,
    MigrationPolicy,
    ProcessSpec,
    RestartPolicy,
    StandbyPolicy,
)
from tests.unit.core.cluster import GIB, Cluster, Machine, movable, process
from tests.unit.core.shelf import PATIENCE, Freezer, Shelf


def playing(
    spec: ProcessSpec | None = None, *others: Machine, **fields: Any
) -> tuple[Shelf, Cluster]:
    """Return a cluster where p runs on a, which takes images."""
    shelf = Shelf("a", **fields)
    cluster = shelf.play(*others)
    cluster.submit(spec or process("p"))
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    return shelf, cluster


def playing_beside_b(then: Any) -> tuple[Shelf, Cluster]:
    """Return a cluster where p runs on a and has this host-loss policy, and b has room."""
    spec = process("p", host_loss=HostLossPolicy(then))
    return playing(spec, Machine("b", busy={"memory": 0.5}))


def is_checkpointed(shelf: Shelf) -> None:
    """Check that p is checkpointed, and its image is on the host."""
    cluster = shelf.cluster
    assert (cluster.phase("p"), cluster.where("p"), shelf.images) == ("checkpointed", [], {1})


def checkpointed(spec: ProcessSpec | None = None, **fields: Any) -> tuple[Shelf, Cluster]:
    """Return a cluster where p is checkpointed on a."""
    shelf, cluster = playing(spec, **fields)
    reply = cluster.checkpoint("p")
    assert (reply.accepted, reply.message) == (True, "p: it is being checkpointed on a")
    return shelf, cluster


POLICIES = pytest.mark.parametrize("then", ["wait", "elsewhere", "stop"])


# --- checkpoint and restore -------------------------------------------------------------------


def test_a_checkpoint_ends_the_process_and_leaves_its_image() -> None:
    """The image keeps the name taken, its host has its room back, and the row names that host."""
    shelf, cluster = checkpointed()
    is_checkpointed(shelf)
    assert cluster["p"].owner == 0
    assert cluster.state.hosts.processes.tolist() == [0]
    assert not cluster.submit(process("p")).accepted
    row = cluster.explain("p")
    assert (row["host"], row["reason"]) == ("a", "its image is on a")
    assert cluster.recorded("checkpointed") == ["p is checkpointed: its image is on a"]
    assert not cluster.intents["migration"]
    cluster.wait(60.0)
    is_checkpointed(shelf)


def test_a_restore_starts_from_the_image() -> None:
    """The restored instance is new, has the process's restart policy, and uses up the image."""
    policy = RestartPolicy("on-failure", delay=0.1)
    shelf, cluster = checkpointed(process("p", restart=policy))
    assert cluster.restore("p").message == "p: it is being restored on a"
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert (shelf.images, shelf.taken, shelf.alive) == (set(), {}, {cluster["p"].owner})
    instance = shelf.machine.find("p")
    assert shelf.machine.programs[instance].assignment.restored
    assert shelf.machine.programs[instance].restart == policy
    assert cluster["p"].image is None
    assert cluster["p"].migrations == 0
    assert cluster.recorded("restored") == ["p was restored from its image on a"]
    assert cluster.checkpoint("p").accepted
    assert shelf.images == {instance.number}


def test_an_explanation_says_what_can_be_requested() -> None:
    """A running process can be checkpointed, and only a checkpointed one restored."""
    shelf, cluster = playing()
    assert cluster.explain("p")["possible"] == {"move": [], "checkpoint": True, "restore": False}
    cluster.checkpoint("p")
    is_checkpointed(shelf)
    assert cluster.explain("p")["possible"] == {"move": [], "checkpoint": False, "restore": True}


def test_a_process_keeps_the_name_of_its_node_through_an_image() -> None:
    """A process that moved by a handoff keeps running under its alias."""
    shelf, cluster = playing()
    cluster.state.instances[cluster["p"].owner].node_name = "p_7"
    cluster.checkpoint("p")
    cluster.restart_master()
    cluster.wait(0.5)
    assert cluster.restore("p").accepted
    assert shelf.machine.programs[shelf.machine.find("p")].assignment.node_name == "p_7"


def test_a_restored_process_that_ends_before_its_plan_does_follows_its_policy() -> None:
    """The image is used up, so the process ends by its policy, like any other."""
    shelf, cluster = checkpointed(process("p", restart=RestartPolicy("never")))
    restored = shelf.machine.executors["await"]

    def end_after(arguments: Any) -> Any:
        result = restored(arguments)
        shelf.machine.finish("p", cluster.now, code=3)
        return result

    shelf.machine.executors["await"] = end_after
    cluster.restore("p")
    cluster.wait(1.0)
    assert "p was restored from its image" in cluster.recorded("restored")[0]
    assert (cluster.where("p"), cluster["p"].image, shelf.images) == ([], None, set())
    assert cluster.phase("p") == "failed"


# --- what fails -------------------------------------------------------------------------------


def test_a_process_that_cannot_be_dumped_keeps_running_with_the_reason() -> None:
    """The process keeps its restart policy, and the record names the reason."""
    policy = RestartPolicy("always")
    shelf, cluster = playing(process("p", restart=policy))
    shelf.trouble["freeze"] = "file descriptor 7 is a pipe"
    cluster.checkpoint("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert shelf.machine.programs[shelf.machine.find("p")].restart == policy
    (said,) = cluster.recorded("checkpoint_failed")
    assert said == (
        "p was not checkpointed and still runs on a: freeze failed on a: file descriptor 7 is a "
        "pipe"
    )
    assert (shelf.frozen, shelf.images) == (set(), set())


@pytest.mark.parametrize("step", ["take", "await", "start"])
def test_a_restore_that_fails_leaves_the_image_where_it_was(step: str) -> None:
    """The process is checkpointed again, with the reason, and can be restored later.

    A host may lose CRIU between checkpoint and restore and refuse the start.
    """
    shelf, cluster = checkpointed()
    faults = shelf.machine.refuses if step == "start" else shelf.trouble
    faults["p" if step == "start" else step] = "its pid 7 is in use here"
    cluster.restore("p")
    cluster.wait(2.0)
    is_checkpointed(shelf)
    assert "its pid 7 is in use here" in cluster.explain("p")["reason"]
    assert "its image is on a; it was not restored" in cluster.explain("p")["reason"]
    assert cluster.state.hosts.processes.tolist() == [0]
    assert "p stays checkpointed on a" in cluster.recorded("restore_failed")[0]
    cluster.restart_master()
    assert "its pid 7 is in use here" in cluster.explain("p")["reason"]
    faults.clear()
    cluster.wait(0.5)
    assert cluster.restore("p").accepted
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])


def test_a_process_that_was_restored_is_not_put_back() -> None:
    """A process keeps running if the answer to its restore was lost.

    An older image would repeat messages that its peers have received.
    """
    shelf, cluster = checkpointed()
    shelf.mute.add("await")
    cluster.restore("p")
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster.where("p"), shelf.images) == ("running", ["a"], set())
    assert cluster.recorded("migration_redone") == [
        f"the restore of p is finished after all: p#{cluster['p'].owner} is active"
    ]


def test_a_cancelled_restore_that_has_succeeded_is_stopped() -> None:
    """The plan undoes, finds the process alive, goes forward, and is cancelled then."""
    shelf, cluster = checkpointed()
    restored = shelf.machine.executors["await"]

    def cancel_meanwhile(arguments: Any) -> Any:
        restored(arguments)
        shelf.machine.executors["await"] = restored
        raise RuntimeError("no answer")

    shelf.machine.executors["await"] = cancel_meanwhile
    shelf.trouble["put_back"] = "busy"
    cluster.restore("p")
    assert cluster.phase("p") == "stuck"
    cluster["p"].wanted = cluster["p"].wanted.CANCEL
    cluster.wait(2.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("cancelled", [])


# --- what is refused --------------------------------------------------------------------------


def test_a_refused_checkpoint_has_its_reason() -> None:
    """A refused checkpoint changes nothing."""
    _, cluster = playing()
    handoff: dict[str, Any] = {"ros": True, "migration": MigrationPolicy("handoff")}
    cluster.submit(
        process("waits", memory=1e9),
        process("watched", standby=StandbyPolicy(True), **handoff),
        process("stateful", **handoff),
    )
    for name in ("watched", "stateful"):
        cluster.discover(name)
    for name, reason in (
        ("x", "no such process: 'x'"),
        ("waits", "only a running process is checkpointed"),
        ("watched", "watched has a standby, which would take over"),
        ("stateful", "is identified by the number of its instance"),
    ):
        reply = cluster.checkpoint(name)
        assert not reply.accepted
        assert reason in reply.message
    assert "p is running; only a checkpointed process is restored" in cluster.restore("p").message
    cluster.checkpoint("p")
    assert "p is checkpointed already: its image is on a" in cluster.checkpoint("p").message
    assert "p is checkpointed: its image is on a; restore it first" in cluster.migrate("p").message


def test_a_plan_in_progress_refuses_another_request() -> None:
    """A plan in progress refuses a second checkpoint, a restore and a restart."""
    shelf, cluster = playing()
    shelf.machine.connected = False
    cluster.checkpoint("p")
    for reply in (cluster.checkpoint("p"), cluster.restore("p"), cluster.migrate("p"),
                  cluster.restart("p")):  # fmt: skip
        assert "p is busy: it is being checkpointed on a" in reply.message


def test_without_a_strategy_that_takes_images_there_is_no_checkpoint() -> None:
    """The refusal names the strategy to use."""
    cluster = Cluster("a").with_processes(movable("p"))
    said = cluster.checkpoint("p").message
    assert "no selected strategy can checkpoint p: name `criu`" in said


def test_a_host_without_the_capability_takes_no_image() -> None:
    """The refusal names the host's own reason."""
    shelf = Shelf("a")
    shelf.trouble["can_freeze"] = "CRIU 3.17 is too old"
    cluster = shelf.play()
    cluster.submit(process("p"))
    reply = cluster.checkpoint("p")
    assert not reply.accepted
    assert "freezer does not work on a: CRIU 3.17 is too old" in reply.message


def test_the_own_strategy_precedes_the_first_selected_one() -> None:
    """A process's own strategy takes its image, even if another selected strategy comes first."""
    shelf = Shelf("a")
    shelf.cluster = cluster = Cluster(
        shelf.machine, strategies={"first": Freezer(), "own": Freezer()}
    )
    cluster.wait(0.5)
    cluster.submit(process("p", migration=MigrationPolicy("own")), process("q"))
    cluster.checkpoint("p")
    cluster.checkpoint("q")
    assert [cluster[name].image.strategy for name in "pq"] == ["own", "first"]  # type: ignore[union-attr]


class Refusing(Freezer):
    """Strategy that refuses every process."""

    def checkpoint(self, move: Move) -> Plan:
        raise ValueError(f"{move.spec.name} holds a camera")


def test_a_strategy_may_refuse_a_process() -> None:
    """The reply contains the strategy's reason."""
    shelf = Shelf("a")
    cluster = Cluster(shelf.machine, strategies={"freezer": Refusing()})
    cluster.wait(0.5)
    cluster.submit(process("p"))
    assert "p holds a camera" in cluster.checkpoint("p").message
    assert (cluster.phase("p"), cluster.state.migrations) == ("running", {})


def test_a_host_that_is_closed_or_away_restores_nothing() -> None:
    """The reply names why the host of the image cannot restore it now."""
    _, cluster = checkpointed()
    cluster.set_host("a", "cordon")
    assert "where its image is, and does not fit there now: it is cordoned" in (
        cluster.restore("p").message
    )
    cluster.set_host("a", "uncordon")
    cluster.cut("a", seconds=60.0)
    assert "on a alone, which is lost" in cluster.restore("p").message
    assert cluster.explain("p")["reason"] == "its image is on a, which is lost"
    cluster.kill_master()
    assert "a, which has not reported" in cluster.explain("p")["reason"]
    cluster.rejoin("a", 0.5)
    assert cluster.explain("p")["reason"] == "its image is on a"
    assert cluster.restore("p").accepted
    assert cluster.phase("p") == "running"


def test_a_restore_needs_the_room_that_the_process_used() -> None:
    """A restore needs the measured usage, not the declared needs.

    Otherwise its host would exceed its limit.
    """
    shelf, cluster = playing()
    shelf.machine.shown["p"] = {"memory": 6 * GIB}
    cluster.wait(0.3)
    cluster.checkpoint("p")
    shelf.machine.shown.clear()
    shelf.machine.busy["memory"] = 0.6
    cluster.wait(0.3)
    reply = cluster.restore("p")
    assert not reply.accepted
    assert "does not fit there now: memory: needs 6.4 GB; at most" in reply.message
    shelf.machine.busy["memory"] = 0.1
    cluster.wait(0.3)
    assert cluster.restore("p").accepted
    reserved = cluster.state.instances[cluster["p"].owner].demand["memory"]
    assert reserved == pytest.approx(6 * GIB)


def test_a_drained_host_says_that_images_stay() -> None:
    """A drained host keeps its images, which can only be restored there."""
    _, cluster = checkpointed()
    cluster.set_host("a", "drain")
    cluster.wait(0.5)
    (message,) = cluster.recorded("host_drained")
    assert "p is checkpointed: its image stays on a" in message


def test_the_record_of_a_checkpoint_names_its_requester() -> None:
    """The record names the requester as the cause of the plan."""
    _, cluster = playing()
    cluster.ask(happened.CheckpointRequested, "p", Requester("anna@desk:42", is_operator=True))
    (message,) = cluster.recorded("checkpoint_begun")
    assert message.endswith("; requested by anna@desk:42")


@POLICIES
def test_a_checkpointed_process_outlives_the_loss_of_its_host(then: Any) -> None:
    """The image is on the host, so no `host_loss` policy ends the process."""
    shelf, cluster = playing_beside_b(then)
    cluster.checkpoint("p")
    cluster.cut("a", seconds=60.0)
    is_checkpointed(shelf)


# --- cancel and restart -----------------------------------------------------------------------


@pytest.mark.parametrize("end", ["cancel", "restart"])
def test_an_unwanted_image_is_removed(end: str) -> None:
    """`cancel` and `restart` remove the image; `restart` starts a new instance."""
    shelf, cluster = checkpointed()
    assert getattr(cluster, end)("p").accepted
    cluster.wait(1.0)
    assert shelf.images == set()
    assert cluster["p"].image is None
    assert cluster.recorded("image_removed") == ["the image of p was removed from a"]
    assert not cluster.intents["cluster"].get("unwanted_images")
    phase, alive = (cluster.phase("p"), cluster.where("p"))
    assert (phase, alive) == (("cancelled", []) if end == "cancel" else ("running", ["a"]))


def test_an_unwanted_image_is_removed_once_its_host_rejoins() -> None:
    """The next master removes it, too."""
    shelf, cluster = checkpointed()
    cluster.cut("a", seconds=2.0)
    cluster.cancel("p")
    cluster.wait(1.0)
    assert shelf.images == {1}
    cluster.kill_master()
    shelf.machine.connected = True
    cluster.restart_master()
    cluster.wait(1.0)
    assert (cluster.phase("p"), shelf.images) == ("cancelled", set())


def test_a_removal_that_fails_is_tried_again() -> None:
    """Each failed attempt is recorded."""
    shelf, cluster = checkpointed()
    shelf.trouble["drop"] = "read-only file system"
    cluster.cancel("p")
    cluster.wait(1.0)
    assert "was not removed from a: read-only file system" in cluster.recorded("image_left")[0]
    shelf.trouble.clear()
    cluster.wait(61.0)
    assert shelf.images == set()


def test_a_checkpoint_that_is_cancelled_ends_the_process() -> None:
    """Before the commit the plan is undone, and the process is stopped like any other."""
    shelf, cluster = playing()
    freeze = shelf.machine.executors["freeze"]

    def slow(arguments: Any) -> Any:
        cluster["p"].wanted = cluster["p"].wanted.CANCEL
        return freeze(arguments)

    shelf.machine.executors["freeze"] = slow
    cluster.checkpoint("p")
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster.where("p"), shelf.images) == ("cancelled", [], set())


def test_after_the_commit_the_plan_waits_for_the_end_of_the_source() -> None:
    """After the commit there is no undo; a cancelled process loses its image too."""
    shelf, cluster = playing()
    shelf.trouble["kill"] = "the host is slow"
    cluster.checkpoint("p")
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster["p"].owner) == ("stuck", 0)
    cluster.cancel("p")
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster.where("p"), shelf.images) == ("cancelled", [], set())


def test_a_former_instance_that_reappears_beside_its_image_is_fenced() -> None:
    """The master fences the former instance, so that it never runs beside its image."""
    shelf, cluster = playing()
    shelf.machine.stubborn.add("p")
    shelf.trouble["kill"] = "no answer"
    cluster.checkpoint("p")
    cluster.wait(1.0)
    number = shelf.machine.find("p")
    cluster.state.drop_instance(cluster.state.instances[number.number])
    cluster.register(shelf.machine)
    cluster.wait(1.0)
    assert FenceInstance(number) in cluster.orders(FenceInstance)


@POLICIES
def test_the_loss_of_the_host_before_the_source_has_ended_loses_no_image(then: Any) -> None:
    """The image owns the name by then; the source is ended when its host rejoins."""
    shelf, cluster = playing_beside_b(then)
    shelf.trouble["kill"] = "no answer"
    cluster.checkpoint("p")
    cluster.cut("a", seconds=60.0)
    assert (cluster.phase("p"), cluster.where("p"), shelf.images) == ("stuck", ["a"], {1})
    shelf.trouble.clear()
    cluster.rejoin("a", 10.0)
    is_checkpointed(shelf)


@POLICIES
def test_a_host_that_is_lost_during_a_restore_decides_after_its_rejoin(then: Any) -> None:
    """The restored process keeps running; no other host starts it before the rejoin."""
    shelf, cluster = playing_beside_b(then)
    cluster.checkpoint("p")
    shelf.trouble.update({"await": "no answer", "put_back": "no answer"})
    cluster.restore("p")
    number = shelf.machine.find("p").number
    shelf.taken.pop(number)
    shelf.alive.add(number)  # restored, but unreported
    cluster.cut("a", seconds=60.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("stuck", ["a"])
    shelf.trouble.clear()
    cluster.rejoin("a", 10.0)
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", number)
    assert (cluster.where("p"), shelf.images) == (["a"], set())


def test_a_process_whose_host_is_lost_during_the_dump_starts_elsewhere() -> None:
    """The process moves by its policy; image and old instance are removed when the host rejoins."""
    shelf, cluster = playing_beside_b("elsewhere")
    freeze = shelf.machine.executors["freeze"]

    def freeze_and_fall(arguments: Any) -> Any:
        freeze(arguments)
        shelf.trouble["thaw"] = "no answer"
        shelf.machine.connected = False
        raise RuntimeError("the disk is full")

    shelf.machine.executors["freeze"] = freeze_and_fall
    cluster.checkpoint("p")
    cluster.wait(90.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a", "b"])
    cluster.rejoin("a", 2.0)
    assert (cluster.where("p"), shelf.images) == (["b"], set())


# --- kill of the master at every point --------------------------------------------------------


class Killed(Exception):
    """Signal that the master was killed."""


def kill_at(cluster: Cluster, turn: int, *, durable: bool) -> Callable[[], None]:
    """Kill the master in its nth turn from now, before or after its decision was made durable.

    Returns:
        a call that lets the next master live.
    """
    left, tell = [turn], cluster.tell

    def told(event: Any) -> list[Command]:
        left[0] -= 1
        if left[0]:
            return tell(event)
        commands = cluster.decide(event)
        if durable:
            cluster.journal(commands)
        raise Killed

    cluster.tell = told  # type: ignore[method-assign]

    def live() -> None:
        cluster.tell = tell  # type: ignore[method-assign]

    return live


def calm(cluster: Cluster) -> str:
    """Return the phase of p once no plan is in progress."""
    for _ in range(60):
        cluster.wait(0.5)
        phase = cluster.phase("p")
        if phase in ("running", "checkpointed") and "p" not in cluster.state.migrations:
            return phase
    raise AssertionError(f"p is {cluster.phase('p')}: {cluster['p'].reason}")


def look(shelf: Shelf, cluster: Cluster, first: int) -> None:
    """Check that the memory of p is in one place: in a running process, or in an image."""
    running = [instance.number for instance in shelf.machine.programs]
    awake = [number for number in running if number not in shelf.frozen]
    if cluster.phase("p") == "checkpointed":
        assert (running, len(shelf.images), shelf.taken) == ([], 1, {})
    else:
        assert awake == running == [cluster["p"].owner]
        assert set(running) <= shelf.alive | {first}, "the process began again"
        assert not shelf.images


@pytest.mark.parametrize("durable", [True, False], ids=["decided", "undecided"])
@pytest.mark.parametrize("asked", ["checkpoint", "restore"])
def test_nothing_is_lost_when_the_master_is_killed_at_any_point(asked: str, durable: bool) -> None:
    """The next master finishes or undoes each step, and the opposite request works afterwards."""
    for turn in range(1, 40):
        shelf, cluster = playing()
        first = cluster["p"].owner
        if asked == "restore":
            cluster.checkpoint("p")
        live = kill_at(cluster, turn, durable=durable)
        try:
            getattr(cluster, asked)("p")
        except Killed:
            pass
        else:
            break
        finally:
            live()
        cluster.restart_master()
        phase = calm(cluster)
        look(shelf, cluster, first)
        other = cluster.checkpoint if phase == "running" else cluster.restore
        assert other("p").accepted
        calm(cluster)
        look(shelf, cluster, first)
    assert turn > 5, "it was killed at every step"


@pytest.mark.parametrize(
    "lost", [AmendInstance, "freeze", "kill", StopInstance, "take", StartInstance, "await"]
)
def test_nothing_is_lost_when_an_answer_is(lost: str | type) -> None:
    """A lost answer leads to an undo or a retry; in the end the process runs or is checkpointed."""
    shelf, cluster = playing()
    first, obey, once = cluster["p"].owner, shelf.machine.obey, [lost]

    def hard_of_hearing(sent: SendOrder, now: float) -> Any:
        answer, order = obey(sent, now), sent.order
        if once and once[0] in (type(order), getattr(order, "executor", "")):
            once.clear()
            cluster.now += PATIENCE + 1.0
            return type(answer)(answer.order, False, "timeout")
        return answer

    shelf.machine.obey = hard_of_hearing  # type: ignore[method-assign]
    cluster.checkpoint("p")
    if calm(cluster) == "checkpointed":
        look(shelf, cluster, first)
        cluster.restore("p")
        calm(cluster)
    look(shelf, cluster, first)
    assert not once or lost in ("take", "await"), "it was lost"


# --- plans ------------------------------------------------------------------------------------

ONE, TWO = InstanceId("p", 1), InstanceId("p", 2)
START = Start(TWO, "a", 1.0)
MOVE = Move(process("p"), ONE, "a", TWO, "a", InstanceId("p", 3), 0, "p")


@pytest.mark.parametrize(
    ("aim", "steps", "fault"),
    [
        (Aim.CHECKPOINT, (Commit(), Stop(ONE, "a", 1.0)), "commits to no image"),
        (Aim.CHECKPOINT, (Commit(image="x"),), "does not stop its source after the commit"),
        (Aim.CHECKPOINT, (Stop(ONE, "a", 1.0), Commit(image="x")), "does not stop its source"),
        (Aim.CHECKPOINT, (START, Commit(image="x"), Stop(ONE, "a", 1.0)), "starts an instance"),
        (Aim.RESTORE, (START, Commit()), "without its image"),
        (Aim.RESTORE, (Commit(),), "never starts or awaits"),
        (Aim.MOVE, (START, Commit(image="x")), "commits to an image"),
        (Aim.MOVE, (START, Commit(), Stop(ONE, "a", 1.0)), "its overlap is 0 s"),
        (Aim.MOVE, (replace(START, node_name="p"), Commit()), "its overlap is 0 s"),
    ],
)
def test_an_unsound_plan_is_refused(aim: Aim, steps: Any, fault: str) -> None:
    """Such a plan could run the source beside its image, lose the state, or never end."""
    assert fault in plan_fault(Plan(steps), MOVE, aim)


@pytest.mark.parametrize(
    ("steps", "overlap"),
    [
        ((START, Commit(), Stop(ONE, "a", 1.0)), 1.0),
        ((Stop(ONE, "a", 1.0), START, Commit()), 0.0),
        ((Execute("x.end", "a", {}, 1.0), START, Commit()), 0.0),
        ((replace(START, node_name="p_2"), Commit()), 0.0),
        ((replace(START, restored=True), Commit()), 0.0),
    ],
)
def test_a_start_that_does_not_wait_for_the_source_is_sound(steps: Any, overlap: float) -> None:
    assert plan_fault(Plan(steps, overlap), MOVE) == ""
