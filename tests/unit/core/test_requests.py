"""Submit, cancel and restart in every phase, each request as a whole."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master import listing
from rosrm.core.slave import events
from rosrm.model.orders import StartInstance, StopInstance
from rosrm.model.plan import Move, Plan
from rosrm.model.requester import Requester
from rosrm.model.values import (
    Component,
    InstanceId,
    InstanceState,
    InstanceStatus,
    MigrationPolicy,
    ProcessSpec,
    RestartPolicy,
)
from tests.unit.core.cluster import Cluster, Machine, job, movable, node, process

# --- submit -----------------------------------------------------------------------------------


def test_a_reply_has_the_number_of_queued_processes() -> None:
    """The reply has the number of processes."""
    cluster = Cluster("a")
    reply = cluster.submit(process("p"), process("q"))
    assert (reply.accepted, reply.message) == (True, "2 processes queued")


@pytest.mark.parametrize(
    ("spec", "code", "reason"),
    [
        (process("p"), "name_taken", "submitted twice at once: p"),
        (
            process("r", migration=MigrationPolicy("teleport")),
            "invalid",
            "the migration strategy 'teleport' is not selected here (selected: handoff",
        ),
    ],
    ids=["name given twice", "unknown strategy"],
)
def test_one_refused_process_refuses_the_submission(
    spec: ProcessSpec, code: str, reason: str
) -> None:
    """No process is queued; the refusal of an unknown strategy lists the selected ones."""
    cluster = Cluster("a")
    reply = cluster.submit(process("p"), process("q"), spec)
    assert (reply.accepted, reply.code) == (False, code)
    assert reason in reply.message
    assert not cluster.state.processes


def test_a_name_in_use_refuses_the_submission() -> None:
    """The name is taken in each phase that is not terminal.

    The refusal lists live processes and those being cancelled, with the reason.
    """
    cluster = Cluster("a").with_processes(*(process(name) for name in "pqrs"))
    reply = cluster.submit(process("t"), process("p"))
    assert (reply.accepted, reply.code) == (False, "name_taken")
    assert reply.message == (
        "the name p is in use already; `rosrm cancel` with the name or the file cancels it. "
        "Nothing was queued"
    )
    cluster.detach("a")
    cluster.cancel("p", "q")
    assert cluster.submit(*(process(name) for name in "pqrst")).message == (
        "the names p and q are still in use: being cancelled: waits for a, whose slave was "
        "stopped; the names r and s are in use already; `rosrm cancel` with the name or the file "
        "cancels them. Nothing was queued"
    )
    assert set(cluster.state.processes) == set("pqrs")


def test_the_name_of_a_terminal_process_can_be_used_again() -> None:
    """The new process is the last in the listing."""
    cluster = Cluster("a").with_processes(job("p"), job("q"))
    cluster.finish("p")
    assert cluster.submit(job("p")).accepted
    assert list(cluster.state.processes) == ["q", "p"]
    assert cluster.phase("p") == "running"


class Choosy:
    """Strategy that refuses every process, with a reason or by an exception."""

    def propose(self, move: Move) -> Plan:
        raise ValueError("it does not")

    def spec_fault(self, spec: ProcessSpec) -> str:
        if spec.name == "raises":
            raise RuntimeError("no idea")
        return "" if spec.migration.options else "it wants options"


def test_the_fault_of_an_option_is_bounded() -> None:
    """Its text is the plugin's, and the refusal has to fit into a message."""

    def refuse(_strategy: str, _spec: ProcessSpec) -> Any:
        raise ValueError("\ud800" + "x" * 3_000_000)

    cluster = Cluster("a", strategies={"choosy": Choosy()})
    cluster.state.declared = replace(cluster.state.declared, options_of=refuse)
    reply = cluster.submit(process("p", migration=MigrationPolicy("choosy")))
    assert not reply.accepted
    assert len(reply.message.encode()) < 10_000


def test_a_submission_warns_of_two_nodes_of_one_name() -> None:
    """The submission is accepted nonetheless, because ROS 2 allows it."""
    cluster = Cluster("a")
    alias = ("--ros-args", "-r", "__node:=p", "-r", "__ns:=/robot")
    cluster.submit(node("p", namespace="/robot"))
    assert cluster.submit(node("other"), node("p2")).message == "2 processes queued"
    reply = cluster.submit(node("q", arguments=alias))
    assert reply.message == (
        "1 process queued. Warning: q and p put the node /robot/p into the ROS graph; give each "
        "node its own name"
    )
    cluster.cancel("p", "q")
    cluster.settle()
    run = {"command": ("ros2", "run", "demo_nodes_cpp", "talker")}
    reply = cluster.submit(process("one", **run), process("two", **run))
    assert "one and two put the default node of demo_nodes_cpp talker into" in reply.message


def test_two_containers_of_one_name_are_refused() -> None:
    """Both would execute each request to load a component; a terminal one does no harm."""
    cluster = Cluster("a")

    def box(name: str, *components: Component) -> ProcessSpec:
        return node(name, node_name="box", components=components or (Component("p", "c"),))

    said = "two containers would load the same components: one and two put the node /box into"
    assert said in cluster.submit(box("one"), box("two")).message
    cluster.submit(box("one"))
    assert "two and one put the node /box into" in cluster.submit(box("two")).message
    cluster.cancel("one")
    cluster.settle()
    assert cluster.submit(box("two")).message == "1 process queued"


def test_a_strategy_may_refuse_a_spec_before_it_is_queued() -> None:
    """The refusal has the strategy's reason; a strategy that raises is named."""
    cluster = Cluster("a", strategies={"choosy": Choosy()})

    def message(name: str, **options: int) -> str:
        policy = MigrationPolicy("choosy", options=options)
        return cluster.submit(process(name, migration=policy)).message

    assert message("p", fast=1) == "1 process queued"
    assert message("q") == "q: migration by 'choosy': it wants options. Nothing was queued"
    assert "its check of this process failed: RuntimeError: no idea" in message("raises")


# --- cancel -----------------------------------------------------------------------------------


def test_cancel_removes_a_waiting_process_from_the_queue() -> None:
    """The processes behind it move up."""
    cluster = Cluster().with_processes(process("p"), process("q"))
    assert cluster.cancel("p").message == "1 process cancelled"
    assert (cluster.phase("p"), cluster.queue()) == ("cancelled", ["q"])


def test_cancel_ends_a_process_that_was_set_aside() -> None:
    """A host that would fit does not bring it back."""
    cluster = Cluster("a").with_processes(process("p", required_labels={"x": "y"}))
    cluster.cancel("p")
    cluster.add(Machine("b", labels={"x": "y"}))
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("cancelled", [])


def test_cancel_prevents_the_start_of_an_assigned_process() -> None:
    """The stop order may overtake the assignment."""
    cluster = Cluster("a")
    cluster.carry_out(cluster.decide(happened.SubmissionReceived(1, (process("p"),))))
    machine = cluster.machines["a"]
    on_its_way, machine.polled = machine.polled, []
    cluster.cancel("p")
    machine.polled = on_its_way
    cluster.settle()
    assert (cluster.phase("p"), cluster.where("p")) == ("cancelled", [])


def test_a_stop_order_repeats_until_the_process_has_ended() -> None:
    """The stop order repeats until the slave reports the end."""
    cluster = Cluster("a", order_retry=2.0)
    cluster.machines["a"].stubborn.add("p")
    cluster.submit(process("p"))
    cluster.cancel("p")
    cluster.wait(5.0)
    assert cluster.phase("p") == "stopping"
    assert len(cluster.orders(StopInstance)) == 3
    cluster.let_go("p")
    assert cluster.phase("p") == "cancelled"


def test_cancel_names_processes_that_ended_before() -> None:
    """The other processes are cancelled."""
    cluster = Cluster("a").with_processes(job("p"), process("q"))
    cluster.finish("p")
    assert cluster.cancel("p", "q").message == "1 process being cancelled; ended before: p"
    assert (cluster.phase("p"), cluster.phase("q")) == ("finished", "cancelled")


def test_an_unknown_name_refuses_the_whole_request() -> None:
    """No process is cancelled or restarted."""
    cluster = Cluster("a").with_processes(process("talker"))
    for ask in (cluster.cancel, cluster.restart):
        reply = ask("talker", "talkre")
        assert (reply.code, reply.message) == (
            "unknown",
            "no such process: 'talkre'; did you mean 'talker'? (`rosrm ps --all` lists them)",
        )
    assert cluster.phase("talker") == "running"


def test_an_unknown_name_is_refused_with_the_known_ones_in_order() -> None:
    """The names have the order of their submission, as in `rosrm ps`."""
    cluster = Cluster("a").with_processes(*map(process, ("camera", "arm", "driver")))
    assert "there are: camera, arm, driver (" in cluster.cancel("zzz").message


@pytest.mark.parametrize("overlap", [True, False])
def test_cancel_during_a_move_ends_both_instances(overlap: bool) -> None:
    """The move is undone at once, and no fallback is started."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}))
    spec = movable("p", overlap=overlap, ros=True)
    cluster.submit(spec)
    cluster.discover("p")
    cluster.migrate("p")
    assert cluster.phase("p") == "migrating"
    assert cluster.where("p") == (["a", "b"] if overlap else ["b"])
    cluster.cancel("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("cancelled", [])
    assert len(cluster.orders(StartInstance)) == 1
    assert not cluster.state.migrations
    assert not cluster.intents["migration"]


# --- restart ----------------------------------------------------------------------------------


def test_the_answer_to_a_restart_says_what_happens_to_each_process() -> None:
    """None of them is restarted yet, and one that has not started starts once."""
    cluster = Cluster("a").with_processes(process("p"), process("q"), process("r"))
    cluster.cancel("q", "r")
    cluster.machines["a"].connected = False
    cluster.submit(process("s"))
    said = "1 process being restarted; 2 processes queued again; 1 process not started yet"
    assert cluster.restart("p", "q", "r", "s").message == said


def test_restart_of_a_running_process_happens_on_its_host() -> None:
    """The instance and the host stay the same, and the process becomes ready again."""
    cluster = Cluster("a").with_processes(process("p"))
    before = cluster.machines["a"].programs[cluster.machines["a"].find("p")].pid
    assert cluster.restart("p").message == "1 process being restarted"
    after = cluster.machines["a"].programs[cluster.machines["a"].find("p")].pid
    assert after > before
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 1)


def test_restart_of_a_terminal_process_queues_it_again() -> None:
    """The process goes to the end of the queue, and may go to any host."""
    cluster = Cluster("a").with_processes(job("p"))
    cluster.finish("p", code=3)
    assert (cluster.phase("p"), cluster["p"].exit_code) == ("failed", 3)
    cluster.restart("p", "p")
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 2)


def test_restart_does_not_prevent_the_start_of_an_assigned_process() -> None:
    """An instance that has not started needs no restart."""
    cluster = Cluster("a")
    cluster.carry_out(cluster.decide(happened.SubmissionReceived(1, (process("p"),))))
    assert cluster.restart("p").accepted
    assert cluster.phase("p") == "running"


@pytest.mark.parametrize("code", [0, 3])
def test_a_restart_is_not_lost_if_the_process_has_just_ended(code: int) -> None:
    """The end was reported before the restart order arrived: the process is queued again."""
    cluster = Cluster("a").with_processes(job("p"))
    cluster.machines["a"].finish("p", cluster.now, code=code)
    assert cluster.restart("p").accepted
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 2)
    assert cluster.recorded("queued") == [
        "p returns to the queue: it ended before it was restarted"
    ]


def test_an_end_after_a_restart_is_final() -> None:
    """The restart was carried out, so a later end counts."""
    cluster = Cluster("a").with_processes(job("p"))
    cluster.restart("p")
    cluster.finish("p")
    assert (cluster.phase("p"), len(cluster.assigned())) == ("finished", 1)


def test_a_restart_before_the_first_run_ends_with_its_start() -> None:
    """The slave need not report the start itself. The later end of the job is final."""
    cluster = Cluster("a").with_processes(job("p"))
    instance = InstanceId("p", cluster["p"].owner)
    cluster.cut("a")
    cluster.report("a", InstanceStatus(instance, InstanceState.BACKOFF))
    cluster.restart("p")
    cluster.report("a", InstanceStatus(instance, InstanceState.RUNNING, pid=9))
    cluster.report("a", InstanceStatus(instance, InstanceState.EXITED, exit_code=0, run_time=1.0))
    assert cluster.phase("p") == "finished"


def test_the_oldest_terminal_processes_are_garbage_collected() -> None:
    """The newest `keep_ended` terminal processes stay in memory and journal.

    All processes that are not terminal stay, too.
    """
    cluster = Cluster("a", keep_ended=2)
    cluster.submit(job("first"), process("lives"), job("second"), job("third"), job("fourth"))
    for name in ("second", "first", "fourth", "third"):
        cluster.machines["a"].finish(name, cluster.now)
    cluster.wait(0.5)
    assert list(cluster.state.processes) == ["lives", "third", "fourth"]
    assert set(cluster.intents["process"]) == {"lives", "third", "fourth"}
    cluster.restart_master()
    assert list(cluster.state.processes) == ["lives", "third", "fourth"]


def test_a_process_waits_for_an_instance_of_its_name_that_a_host_reports_late() -> None:
    """Its name may be given to another process, which does not start beside the instance."""
    cluster = Cluster("a", keep_ended=1).with_processes(process("p"), job("q"))
    cluster.cancel("p")
    assert cluster.phase("p") == "cancelled"
    # A late status shows that an instance of p still runs.
    machine = cluster.machines["a"]
    late = InstanceStatus(InstanceId("p", 77), InstanceState.RUNNING, pid=5)
    machine.stubborn.add("p")
    machine.tell(events.SupervisorReported((late,)), cluster.now)
    cluster.settle()
    machine.finish("q", cluster.now)
    cluster.wait(0.5)
    assert cluster.submit(process("p")).accepted
    cluster.wait(0.5)
    assert (cluster.phase("p"), cluster.where("p")) == ("queued", [])


def test_a_process_that_runs_again_is_not_terminal() -> None:
    """A process that was restarted or submitted again counts as newest at its next end."""
    cluster = Cluster("a", keep_ended=1).with_processes(job("p"))
    cluster.finish("p")
    cluster.restart("p")
    cluster.submit(job("q"))
    cluster.machines["a"].finish("q", cluster.now)
    cluster.wait(0.5)
    assert set(cluster.state.processes) == {"q", "p"}
    cluster.machines["a"].finish("p", cluster.now)
    cluster.wait(0.5)
    assert list(cluster.state.processes) == ["p"]


def test_restart_is_refused_where_it_makes_no_sense() -> None:
    """The refusal has the reason: waiting, stopping, moving or unreachable. Nothing restarts."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}))
    cluster.machines["a"].stubborn.add("stops")
    cluster.submit(
        *(process("stops"), movable("moves", ros=True), process("huge", memory=1e6), process("p"))
    )
    cluster.discover("moves")
    cluster.migrate("moves")
    cluster.cancel("stops")
    for name, reason in (
        ("huge", "huge is set aside: no host may take it"),
        ("stops", "is being stopped"),
        ("moves", "is moving"),
    ):
        reply = cluster.restart(name)
        assert not reply.accepted
        assert reason in reply.message
    cluster.cut("a", seconds=11.0)
    assert cluster.restart("p").message == "p is out of reach: a is lost. Nothing was restarted"


# --- ends -------------------------------------------------------------------------------------


def test_a_job_that_exits_with_0_has_finished_one_that_does_not_has_failed() -> None:
    """The listing shows the exit code."""
    cluster = Cluster("a").with_processes(job("good"), job("bad"))
    cluster.machines["a"].finish("good", cluster.now)
    cluster.finish("bad", code=7)
    assert (cluster.phase("good"), cluster.phase("bad")) == ("finished", "failed")
    assert (cluster["bad"].exit_code, cluster["bad"].reason) == (7, "exit code 7")


def test_a_node_that_never_appears_in_the_graph_fails() -> None:
    """Its slave reports the failure after the readiness time-out."""
    cluster = Cluster("a").with_processes(node("p"))
    cluster.wait(21.0)
    assert cluster.phase("p") == "failed"
    assert "not ready within 20 s" in cluster["p"].reason


def test_after_a_refused_start_another_host_is_tried() -> None:
    """A missing executable on one host is no failure of the process."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}))
    cluster.machines["a"].refuses["p"] = "no such executable"
    cluster.submit(process("p"))
    assert cluster.where("p") == ["b"]
    (said,) = cluster.recorded("queued")
    assert said == "p returns to the queue: a cannot run it: no such executable"


def test_a_process_that_every_host_refuses_has_failed() -> None:
    """The reason lists each host's reason; hosts excluded by labels do not count."""
    cluster = Cluster(*[
        Machine(name, labels={"x": "y"} if name != "c" else {}, refuses={"p": f"not on {name}"})
        for name in "abc"
    ])  # fmt: skip
    cluster.submit(process("p", required_labels={"x": "y"}), process("q"))
    assert cluster.phase("p") == "failed"
    assert "no host can start it: a: not on a; b: not on b" in cluster["p"].reason
    decision = cluster.explain("p")["decision"]
    found = {one["name"]: (one["verdict"], one["reason"]) for one in decision["hosts"]}
    assert (decision["chosen"], found["a"]) == (None, ("excluded", "not on a"))
    assert cluster.phase("q") == "running"


def test_equal_refusals_are_listed_once_without_their_details() -> None:
    """The details are on further lines, also in events: `rosrm.master.disclosure` joins them."""
    refusal = "program 'p' is not on the PATH\nthe PATH is /bin"
    cluster = Cluster(*[Machine(name, refuses={"p": refusal}) for name in "abcd"])
    cluster.submit(process("p"))
    assert cluster["p"].reason == (
        "no host can start it: a, b and 2 more: program 'p' is not on the PATH"
    )
    assert cluster.recorded("queued")[0] == f"p returns to the queue: a cannot run it: {refusal}"
    assert refusal in cluster.explain("p")["history"][-2]["message"]


def test_the_next_run_of_a_slave_may_accept_a_process_that_the_former_refused() -> None:
    """The new run of the slave clears the former refusal."""
    a = Machine("a", refuses={"p": "no such package"})
    cluster = Cluster(a, Machine("b", max_processes=1, labels={"x": "y"}))
    cluster.submit(process("filler", required_labels={"x": "y"}), process("p"))
    assert cluster.queue() == ["p"]  # b may take it once it has room
    a.refuses.clear()
    cluster.cut("a", seconds=2.0)
    cluster.restart_slave("a")
    assert cluster.where("p") == ["a"]


def test_an_assignment_that_is_not_accepted_is_withdrawn() -> None:
    """After the delivery time-out the process returns to its place, and goes to another host."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}), delivery_timeout=5.0)
    cluster.carry_out(cluster.decide(happened.SubmissionReceived(1, (process("p"),))))
    cluster.machines["a"].connected = False  # cut off, though its readings arrive
    for _ in range(60):
        cluster.now += 0.1
        cluster.tell(cluster.readings([cluster.machines["a"], cluster.machines["b"]]))
        cluster.tell(happened.TimePassed())
        if cluster.now > 104.0:
            cluster.set_host("a", "cordon")
    cluster.settle()
    assert cluster.where("p") == ["b"]
    assert "a did not accept the assignment in time" in cluster.recorded("queued")[0]


def test_an_assignment_whose_answer_is_lost_is_stopped_before_the_next() -> None:
    """A later refusal by its host does not exclude that host."""
    cluster = Cluster(
        "a", Machine("b", busy={"memory": 0.5}), delivery_timeout=5.0, order_retry=9.0
    )
    cluster.carry_out(cluster.decide(happened.SubmissionReceived(1, (process("p"),))))
    cluster.machines["a"].polled.clear()  # fetched, and the answer got lost
    cluster.wait(4.9)
    assert cluster.phase("p") == "assigned"
    cluster.wait(1.0)
    assert cluster.phase("p") == "running"
    assert cluster["p"].owner == 2
    assert not cluster["p"].excluded


def wait_one_way(cluster: Cluster, host: str, seconds: float) -> None:
    """Let time pass in which all messages of a host arrive, and none to it."""
    machine = cluster.machines[host]
    machine.connected = False
    for _ in range(round(seconds / 0.1)):
        cluster.wait(0.1)
        cluster.tell(cluster.readings([machine]))
        machine.ordered.clear()
        machine.polled.clear()


@pytest.mark.parametrize("cancelled", [False, True])
def test_an_assignment_to_a_host_that_only_sends_ends(cancelled: bool) -> None:
    """The process is placed elsewhere, and the host gets no work until it answers."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}), delivery_timeout=5.0, lease=10.0)
    cluster.machines["a"].connected = False
    cluster.submit(process("p"))
    assert cluster.phase("p") == "assigned"
    if cancelled:
        cluster.cancel("p")
    wait_one_way(cluster, "a", 14.0)
    assert cluster.where("p") == []
    wait_one_way(cluster, "a", 2.0)
    found = cluster.phase("p"), cluster.where("p")
    assert found == (("cancelled", []) if cancelled else ("running", ["b"]))
    cluster.submit(process("q"))
    wait_one_way(cluster, "a", 1.0)
    assert cluster.where("q") == ["b"]
    cluster.reconnect("a", seconds=60.0)
    cluster.submit(process("r"))
    cluster.wait(1.0)
    assert cluster.where("r") == ["a"]


def test_an_instance_that_appears_after_its_withdrawal_is_stopped() -> None:
    """The late instance is stopped first, so that two are never active."""
    cluster = Cluster("a", delivery_timeout=5.0)
    cluster.carry_out(cluster.decide(happened.SubmissionReceived(1, (process("p"),))))
    machine = cluster.machines["a"]
    machine.fetch(cluster.now)
    late, machine.status_batches = list(machine.status_batches), type(machine.status_batches)()
    machine.batches = 0
    for _ in range(60):
        cluster.now += 0.1
        cluster.tell(cluster.readings([machine]))
        cluster.tell(happened.TimePassed())
    machine.status_batches.extend(late)
    machine.batches = len(late)
    cluster.settle()
    cluster.wait(1.0)
    assert cluster.where("p") == ["a"]
    assert cluster["p"].owner == 2
    assert cluster.phase("p") == "running"


# --- requester --------------------------------------------------------------------------------


def test_the_record_of_a_request_names_its_requester() -> None:
    """The message and `by` of the facts name the requester.

    Records of moves name it in their cause.
    """
    cluster = Cluster("a")
    by = Requester("anna@desk:42", is_operator=True)
    cluster.ask(happened.SubmissionReceived, (movable("p"), process("q")), by)
    cluster.add("b")
    cluster.ask(happened.MigrationRequested, "p", "b", by)
    cluster.ask(happened.RestartRequested, ("q",), by)
    cluster.ask(happened.CancelRequested, ("q",), by)
    cluster.ask(happened.HostStateRequested, "a", "drain", by)
    cluster.ask(happened.PruneRequested, ("q",), (), by)
    for kind in ("submitted", "restart_requested", "cancel_requested", "host_draining", "pruned"):
        record = next(record for record in cluster.records if record.kind == kind)
        assert record.message.endswith(" (by anna@desk:42)"), kind
        assert record.facts["by"] == by.name
    assert cluster.recorded("migration_begun")[0].endswith("requested by anna@desk:42")


def test_a_process_without_an_owner_is_cancelled_when_its_last_instance_has_ended() -> None:
    """The process shows as being cancelled while that instance runs."""
    cluster = Cluster("a")
    cluster.machines["a"].stubborn.add("p")
    cluster.submit(process("p"))
    cluster.cancel("p")
    cluster.kill_master()
    cluster["p"].owner = 0
    cluster.cancel("p")
    waits = "waits until p#1 on a has ended"
    assert (cluster.phase("p"), cluster["p"].reason) == ("stopping", waits)
    cluster.machines["a"].let_go("p", cluster.now)
    cluster.rejoin("a")
    assert cluster.phase("p") == "cancelled"


def test_only_a_node_in_the_graph_is_recorded_as_ready() -> None:
    """Any other program is running: it may end at once, such as a module that does not exist."""
    cluster = Cluster("a").with_processes(process("p"), job("q"), node("r"))
    cluster.discover("r", "a")
    assert cluster.recorded("ready") == ["r is ready on a"]
    assert cluster.recorded("running") == ["p is running on a", "q is running on a"]


def test_a_node_is_starting_until_the_ros_graph_shows_it() -> None:
    """The reason has the node's full name and the time-out; once the node appears, it is empty."""
    cluster = Cluster("a").with_processes(node("p", namespace="/robot"))
    waits = "waits for its node /robot/p in the ROS graph, for at most 20 s"
    row = listing.process_row(cluster.state, cluster["p"], cluster.now)
    assert (row.state, row.reason, cluster.explain("p")["reason"]) == ("starting", waits, waits)
    cluster.discover("p")
    row = listing.process_row(cluster.state, cluster["p"], cluster.now)
    assert (row.state, row.reason) == ("running", "")


def test_an_explanation_has_the_next_command() -> None:
    """The advice names `logs` and `restart` for a failed process.

    For an unreachable one it names the slave to start.
    """
    cluster = Cluster("a")
    failing = process("p", restart=RestartPolicy("never"))
    cluster.submit(failing, process("q"))
    cluster.finish("p", code=2)
    assert cluster.explain("p")["reason"] == "exit code 2"
    assert cluster.explain("p")["advice"] == (
        "`rosrm logs p` shows its output, `rosrm restart p` starts it again; "
        "to correct it, `rosrm submit` a file with this process alone"
    )
    assert not cluster.submit(failing, process("q")).accepted
    assert cluster.submit(failing).accepted
    cluster.detach("a")
    assert cluster.explain("q")["advice"] == "start the slave of a again"


def test_the_advice_for_a_failed_part_of_an_application_names_apply() -> None:
    """The master refuses its submission."""
    cluster = Cluster("a")
    part = process("p", restart=RestartPolicy("never"))
    cluster.apply("nav", part)
    cluster.finish("p", code=2)
    assert not cluster.submit(replace(part, application="nav")).accepted
    assert cluster.explain("p")["advice"].endswith(
        "to correct it, change its file and `rosrm apply` it again"
    )
