"""Oracle of the chaos benchmark: violations and allowances."""

from __future__ import annotations

import ast
import time
from dataclasses import replace
from pathlib import Path

import pytest

import benchmarks.chaos
from benchmarks.chaos.allowances import OVERLOAD, Disturbance, Guarantees
from benchmarks.chaos.oracle import AcceptedRequests, Oracle, Versions
from benchmarks.chaos.outputs import Outputs, Run
from benchmarks.chaos.reality import Member
from benchmarks.chaos.rules import (
    Judgement,
    chain,
    judge_job,
    judge_line,
    judge_service,
    judge_versions,
)

FOLDER = Path(benchmarks.chaos.__file__).parent
JUDGES = ["oracle.py", "reality.py", "outputs.py", "rules.py", "allowances.py"]


@pytest.mark.parametrize("name", JUDGES)
def test_the_oracle_knows_nothing_of_rosrm(name):
    """Neither the oracle nor its imports import rosrm."""
    for node in ast.walk(ast.parse((FOLDER / name).read_text())):
        if isinstance(node, ast.Import | ast.ImportFrom):
            modules = [alias.name for alias in node.names]
            modules += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not [one for one in modules if one.split(".")[0] == "rosrm"]
            ours = [one for one in modules if one.startswith("benchmarks")]
            assert {one.split(".")[2] + ".py" for one in ours if one.count(".") > 1} <= {*JUDGES}


def run(instance="a#1", host="host1", first=10.0, last=20.0, numbers=(1, 100), pid=5):
    return Run(instance, host, pid, first - 0.1, first, last, *numbers, "active", last)


def kinds(*arguments):
    judged = judge_service("a", *arguments)
    return [one.kind for one in judged.violations], dict(judged.allowed)


FIRST, SECOND = run(), run("a#2", "host2", 21.0, 30.0, (101, 200))
KILLED = Disturbance("process_kill", 20.0, 20.0, process="a")
CUT = Disturbance("host_cut", 12.0, 19.0, frozenset({"host1"}), hides=True)
OFF = Disturbance("host_off", 20.0, 25.0, frozenset({"host1"}), kills=True, hides=True)


def test_a_process_without_a_disturbance_must_not_end():
    """Only a killed process, or one on a host that lost its power, may end."""
    plain = Guarantees()
    assert kinds(plain, [FIRST, SECOND], []) == (["touched"], {})
    assert kinds(plain, [FIRST, SECOND], [KILLED]) == ([], {})
    assert kinds(plain, [FIRST, SECOND], [OFF]) == ([], {})
    assert kinds(plain, [FIRST, SECOND], [CUT]) == (["touched"], {})
    assert kinds(Guarantees(elsewhere=True), [FIRST, SECOND], [CUT]) == ([], {})
    other = Disturbance("host_off", 20.0, 25.0, frozenset({"host2"}), kills=True)
    assert kinds(plain, [FIRST, SECOND], [other]) == (["touched"], {})


def test_two_active_owners_only_while_they_were_parted():
    """The allowance covers one second after the partition; with `isolation: stop` there is none."""
    longer, beside = run(last=24.0), run("a#2", "host2", 16.0, 30.0)
    elsewhere = Guarantees(elsewhere=True)
    assert kinds(elsewhere, [run(last=19.5), beside], [CUT]) == ([], {"partitioned": 1})
    parted = judge_service("a", elsewhere, [run(last=19.5), beside], [CUT]).parted
    assert parted == pytest.approx([0.5])
    assert kinds(elsewhere, [longer, beside], [CUT])[0] == ["doubled"]
    assert kinds(Guarantees(), [longer, beside], [KILLED])[0] == ["doubled"]
    isolated = Guarantees(elsewhere=True, isolated=True)
    assert kinds(isolated, [run(last=17.0), beside], [CUT])[0] == ["doubled"]
    overlap = Disturbance("overlap", 15.0, 15.0, process="a")
    assert kinds(Guarantees(), [longer, beside], [overlap]) == ([], {"overlaps": 1})


def test_a_host_that_comes_up_late_is_given_its_second_from_then_on():
    """The host has reached the master at the latest when it begins a job."""
    late, beside = run(last=40.5), run("a#2", "host2", 16.0, 50.0)
    elsewhere = Guarantees(elsewhere=True)
    assert judge_service("a", elsewhere, [late, beside], [CUT]).violations != []
    assert judge_service("a", elsewhere, [late, beside], [CUT], {"host1": 40.0}).violations == []


def test_an_overloaded_machine_explains_what_nothing_else_does():
    """An overload does not delay the cut of a host."""
    late, beside = run(last=29.0), run("a#2", "host2", 16.0, 30.0)
    overload = Disturbance(OVERLOAD, 10.0, 30.0, frozenset({"*"}), hides=True)
    elsewhere = Guarantees(elsewhere=True)
    assert kinds(elsewhere, [late, beside], [overload]) == ([], {"partitioned": 1})
    assert kinds(elsewhere, [late, beside], [overload, CUT])[0] == ["doubled"]


def test_an_instance_that_returns_for_a_moment_does_not_end_the_owner():
    """A lost host has its power again, and starts a process that has a successor by now."""
    old, owner = run(last=20.0), run("a#2", "host2", 24.0, 40.0)
    back = run("a#1", "host1", 25.5, 25.6, pid=9)
    assert chain([old, owner, back]) == [old, back, owner]
    excused = kinds(Guarantees(elsewhere=True), chain([old, owner, back]), [OFF])
    assert excused == ([], {"partitioned": 1})


def test_a_move_loses_and_repeats_nothing():
    stateful, move = Guarantees(stateful=True), Disturbance("move", 15.0, 15.0, process="a")
    assert kinds(stateful, [FIRST, SECOND], [move]) == ([], {})
    for first in (1, 100, 102):
        follower = run("a#2", "host2", 21.0, 30.0, (first, first + 9))
        assert kinds(stateful, [FIRST, follower], [move])[0] == ["state"]


SHORT = Disturbance("host_cut", 19.6, 19.9, frozenset({"host1"}), hides=True)


def test_a_silence_too_short_to_lose_a_host_or_to_be_fenced_excuses_nothing():
    """Two seconds may lose a host; for `isolation: stop`, 0.8 s is less than its fence may take."""
    elsewhere, isolated = Guarantees(elsewhere=True), Guarantees(elsewhere=True, isolated=True)
    bounds = [(elsewhere, 1.9, ["touched"]), (elsewhere, 2.1, []),
              (isolated, 0.7, ["touched"]), (isolated, 0.9, [])]  # fmt: skip
    for guarantees, seconds, violations in bounds:
        cut = Disturbance("host_cut", 20.0 - seconds, 20.0, frozenset({"host1"}), hides=True)
        assert kinds(guarantees, [FIRST, SECOND], [cut])[0] == violations


def test_silences_add_up_and_a_part_that_starts_again_is_silent_until_it_is_up():
    """Overlapping silences count once, and time after the end of a run does not count."""
    elsewhere, everywhere = Guarantees(elsewhere=True), frozenset({"*"})
    long = Disturbance("host_cut", 17.0, 18.8, frozenset({"host1"}), hides=True)
    beside = replace(long, kind="master_stop", hosts=everywhere, ended=18.5)
    killed = Disturbance("master_kill", 17.0, 17.2, everywhere, hides=True, restarts=True)
    late = replace(long, begun=19.5, ended=25.0)
    assert kinds(elsewhere, [FIRST, SECOND], [long])[0] == ["touched"]
    assert kinds(elsewhere, [FIRST, SECOND], [long, SHORT])[0] == []
    assert kinds(elsewhere, [FIRST, SECOND], [long, beside])[0] == ["touched"]
    assert kinds(elsewhere, [FIRST, SECOND], [killed])[0] == []
    assert kinds(elsewhere, [FIRST, SECOND], [late])[0] == ["touched"]


def test_a_slave_that_is_stopped_lets_its_host_fence_sooner_than_the_host_is_lost():
    """A killed supervisor ends nothing."""
    elsewhere = Guarantees(elsewhere=True)
    slave = Disturbance("slave_stop", 18.5, 20.0, frozenset({"host1"}), hides=True, deafens=True)
    assert kinds(elsewhere, [FIRST, SECOND], [slave])[0] == []
    assert kinds(elsewhere, [FIRST, SECOND], [replace(slave, deafens=False)])[0] == ["touched"]


def test_the_state_of_a_killed_node_continues_where_a_snapshot_is():
    """A second of it may be repeated.

    Without a replica, a start on another host is from nothing.
    """
    kept, copied = (
        Guarantees(stateful=True, kept=True),
        Guarantees(stateful=True, kept=True, copied=5),
    )

    def after(guarantees, first, host, *disturbances):
        return kinds(
            guarantees, [FIRST, run("a#2", host, 21.0, 30.0, (first, 200))], [*disturbances, KILLED]
        )

    full = Disturbance("disk_full", 5.0, 30.0, frozenset({"host1"}), fills=True)
    late = replace(full, begun=18.0)
    allowed = [
        (kept, 99, "host1", "state_cycles_repeated"), (kept, 90, "host1", "state_seconds_repeated"),
        (kept, 50, "host1", "state_older_disk_full", full),
        (kept, 1, "host2", "state_from_nothing"),
        (copied, 80, "host2", "state_older_disk_full", late),
        (copied, 96, "host2", "state_seconds_repeated"),
    ]  # fmt: skip
    for guarantees, first, host, kind, *disturbances in allowed:
        assert after(guarantees, first, host, *disturbances) == ([], {kind: 1})
    violated = [
        *((kept, first, "host1") for first in (88, 102, 1)), (kept, 50, "host1", late),
        (kept, 50, "host1", replace(full, hosts=frozenset({"host3"}))), (kept, 50, "host2"),
        (copied, 95, "host2"), (copied, 1, "host2"),
        (Guarantees(stateful=True, standby=True), 1, "host2"),
    ]  # fmt: skip
    for guarantees, first, host, *disturbances in violated:
        assert after(guarantees, first, host, *disturbances)[0] == ["state"]


def test_a_standby_lacks_the_cycles_of_a_host_that_is_cut_off():
    """Missing cycles count from the cut on, at ten a second."""
    guarded = Guarantees(stateful=True, standby=True, elsewhere=True)
    alone = run(first=10.0, last=19.5, numbers=(1, 96))  # cut off from 12.0 on

    def taken_over(first):
        return kinds(guarded, [alone, run("a#2", "host2", 13.0, 30.0, (first, 200))], [CUT])

    assert taken_over(22) == ([], {"partitioned": 1, "state_seconds_repeated": 1})
    assert taken_over(15)[0] == ["state"]


def test_a_state_that_came_to_no_other_host_in_time_is_lost():
    """The process was young, or the host of the replica was struck as well."""
    copied = Guarantees(stateful=True, kept=True, copied=5, elsewhere=True)
    fresh = run("a#2", "host2", 23.0, 30.0, (1, 50))
    other = Disturbance("host_off", 19.0, 25.0, frozenset({"host3"}), kills=True, hides=True)
    overload = Disturbance(OVERLOAD, 10.0, 30.0, frozenset({"*"}), hides=True, deafens=True)
    assert kinds(copied, [FIRST, fresh], [OFF])[0] == ["state"]
    same, short = replace(other, hosts=OFF.hosts), replace(SHORT, hosts=other.hosts)
    for none in (overload, KILLED, same, short):
        assert kinds(copied, [FIRST, fresh], [OFF, none])[0] == ["state"]
    unrelated = [replace(other, hosts=frozenset({host})) for host in ("host3", "host4")]
    assert kinds(copied, [FIRST, fresh], [KILLED, *unrelated])[0] == ["state"]
    assert kinds(copied, [FIRST, fresh], [OFF, other]) == ([], {"state_from_nothing": 1})
    young = run(first=17.0, numbers=(1, 31))
    assert kinds(copied, [young, fresh], [OFF]) == ([], {"state_seconds_repeated": 1})
    young_and_far = run(first=17.0, numbers=(501, 531))
    assert kinds(copied, [young_and_far, fresh], [OFF]) == ([], {"state_from_nothing": 1})


def test_the_state_of_an_earlier_instance_follows_only_if_the_newer_one_is_out_of_reach():
    """In a partition the earlier instance ran on, so its state is ahead of its successor's."""
    copied = Guarantees(stateful=True, kept=True, copied=30, elsewhere=True)
    apart = Disturbance("host_cut", 10.0, 26.0, frozenset({"host1"}), hides=True)
    former = run(last=25.0, numbers=(1, 150))
    newer = run("a#2", "host2", 15.0, 30.0, (51, 140))
    lost = Disturbance("host_off", 30.0, 40.0, frozenset({"host2"}), kills=True, hides=True)
    replica = Disturbance("host_off", 30.0, 40.0, frozenset({"host3"}), kills=True, hides=True)
    back = run("a#3", "host1", 35.0, 50.0, (151, 200))
    violations, allowed = kinds(copied, [former, newer, back], [apart, lost, replica])
    assert (violations, allowed["state_of_an_earlier_instance"]) == ([], 1)
    killed, same = replace(KILLED, begun=30.0, ended=30.0), replace(back, host="host2")
    assert kinds(copied, [former, newer, same], [apart, killed])[0] == ["state"]


def test_a_standby_bears_one_fault_and_the_copy_another():
    """With `isolation: stop`, a silent master costs both the primary and its standby."""
    guarded = Guarantees(stateful=True, standby=True, elsewhere=True, kept=True, copied=5)
    isolated = Guarantees(
        stateful=True, standby=True, elsewhere=True, isolated=True, kept=True, copied=5
    )
    silent = Disturbance("master_stop", 18.0, 25.0, frozenset({"*"}), hides=True)
    other = Disturbance("slave_kill", 20.0, 22.0, frozenset({"host3"}), hides=True)
    behind = run("a#2", "host2", 23.0, 30.0, (97, 200))
    assert kinds(guarded, [FIRST, behind], [OFF])[0] == ["state"]
    assert kinds(guarded, [FIRST, behind], [OFF, other]) == ([], {"state_seconds_repeated": 1})
    assert kinds(isolated, [FIRST, behind], [silent]) == ([], {"state_seconds_repeated": 1})


def test_one_run_never_goes_back():
    backwards = run()
    backwards.backwards = 1
    assert kinds(Guarantees(), [backwards], [])[0] == ["state"]


def test_a_job_is_done_once_unless_something_was_done_to_it():
    twice = [run("j#1"), run("j#2")]
    assert judge_job("j", 9.0, twice[:1], []) == Judgement()
    assert [one.kind for one in judge_job("j", 9.0, twice, []).violations] == ["repeated"]
    assert judge_job("j", 9.0, twice, [OFF]).violations == []
    assert judge_job("j", 26.0, twice, [OFF]).violations != []


def test_who_waits_in_line_keeps_its_place():
    line = {"one": [run(first=1.0)], "two": [run(first=3.0)], "three": [run(first=2.0)]}
    assert [(one.kind, one.name) for one in judge_line(line)] == [("order", "three")]


@pytest.mark.parametrize(
    ("versions", "may_return", "violations"),
    [
        ([1, 1, 2], False, 0), ([1, 2, 1], False, 1), ([1, 2, 1], True, 0), ([1, 3], True, 1),
        ([2], False, 0), ([], False, 0),
    ],
)  # fmt: skip
def test_a_version_follows_the_former_one_unless_the_application_returned(
    versions, may_return, violations
):
    """No run has a version that was not requested, and none of the former one comes later."""
    runs = [replace(run(), version=version) for version in versions]
    judged = judge_versions("a", runs, 1, 2, may_return=may_return)
    assert [one.kind for one in judged] == ["versions"] * violations


def test_all_processes_have_the_version_that_the_application_reports(tmp_path):
    """The former version is right if and only if the application returned to it."""
    versions = Versions(("a",), former=1, newest=2)
    oracle = Oracle("no-lab", tmp_path, AcceptedRequests(versions=versions))
    now = time.monotonic()
    (tmp_path / "a").write_text(f"{now} a#1 host1 5 {now} 1 active 1\n")
    assert [one.kind for one in oracle.deviations()] == ["versions"]
    versions.returned = "a: exit code 3"
    assert oracle.deviations() == []


@pytest.mark.parametrize(("line", "deviations"), [("born 0", ["standby"]), ("restored 7", [])])
def test_a_standby_without_the_state_of_its_primary_is_a_deviation(
    tmp_path, monkeypatch, line, deviations
):
    """A fault in this moment would test no promise: the process starts from its snapshot."""
    there = [Member(5, "a", "a#1", "host1", "S"), Member(6, "a", "a#2", "host2", "S")]
    monkeypatch.setattr("benchmarks.chaos.oracle.members", lambda _: there)
    guarded = {"a": Guarantees(stateful=True, standby=True)}
    oracle = Oracle("no-lab", tmp_path, AcceptedRequests(services=guarded))
    now = time.monotonic()
    (tmp_path / "a").write_text(
        f"{now} a#1 host1 5 {now} 0 active 8\n{now} a#2 host2 6 {now} 0 {line}\n"
    )
    assert [one.kind for one in oracle.deviations()] == deviations


def test_lines_become_runs_as_they_grow(tmp_path):
    """Half a line waits for its rest; a restart under the same name is another run."""
    file, outputs = tmp_path / "a", Outputs(tmp_path)
    assert outputs.read("a") == []
    file.write_text("1.0 a#1 host1 5 0.9 7 born 0\n1.1 a#1 host1 5 0.9 7 active 1\n1.2 a#1 ho")
    assert [(one.first, one.last_number) for one in outputs.read("a")] == [(1.1, 1)]
    with file.open("a") as more:
        more.write("st1 5 0.9 7 active 2\n3.0 a#1 host1 9 2.9 0 active 1\n")
    first, second = outputs.read("a")
    assert (first.last, first.last_number, second.pid) == (1.2, 2, 9)
    assert (first.version, second.version) == (7, 0)
    assert chain([second, first]) == [first, second]
    outputs.forget("a", before=2.0)
    assert outputs.read("a") == [second]
