"""Commands that change something, and their error messages."""

from __future__ import annotations

import io
import re
from functools import partial
from types import SimpleNamespace

import pytest

from rosrm.errors import NoMaster, Refused

from .conftest import event, host, interrupt, process


@pytest.fixture
def work(tmp_path):
    path = tmp_path / "work.yaml"
    path.write_text(
        "processes:\n  - {name: a, command: x, kind: job}\n  - {name: b, command: x}\n",
        encoding="utf-8",
    )
    return path


@pytest.mark.parametrize(
    ("words", "asked", "said"),
    [
        (["cancel", "a", "b"], ("cancel", ["a", "b"]), "cancelled\n"),
        (["restart", "a"], ("restart", ["a"]), "restarted\n"),
        (["migrate", "a"], ("migrate", "a", None), "moving\n"),
        (["migrate", "a", "--to", "beta"], ("migrate", "a", "beta"), "moving\n"),
        (["checkpoint", "a"], ("checkpoint", "a"), "a: it is being checkpointed\n"),
        (["restore", "a"], ("restore", "a"), "a: it is being restored\n"),
        (["cordon", "alpha"], ("cordon", "alpha"), "alpha: cordon\n"),
        (["uncordon", "alpha"], ("uncordon", "alpha"), "alpha: uncordon\n"),
        (["drain", "alpha"], ("drain", "alpha"), "alpha: drain\n"),
        (["prune"], ("prune", [], []), "removed\n"),
        (["prune", "a", "--host", "beta"], ("prune", ["a"], ["beta"]), "removed\n"),
    ],
)
def test_a_command_asks_the_master_and_prints_its_answer(rosrm, client, words, asked, said):
    result = rosrm(*words)
    assert (result.code, result.out, result.err) == (0, said, "")
    assert client.asked == [asked]
    assert client.closed


@pytest.mark.parametrize(
    ("action", "kind", "message", "code"),
    [
        ("checkpoint", "checkpointed", "a is checkpointed: its image is on alpha", 0),
        ("checkpoint", "checkpoint_failed",
         "a was not checkpointed and still runs on alpha: it holds a pipe", 1),
        ("restore", "restored", "a was restored from its image on alpha", 0),
        ("restore", "restore_failed", "a stays checkpointed on alpha: a port is in use", 1),
        ("restore", "cancelled", "a cancelled; its image is removed", 1),
        ("migrate", "migrated", "a moved from alpha to beta", 0),
        ("migrate", "stayed", "a stayed on alpha: beta did not start it", 1),
        ("migrate", "migration_forgotten", "the move of a cannot be continued: no plan", 1),
    ],
)  # fmt: skip
def test_wait_says_how_a_checkpoint_a_restore_or_a_move_ended(
    rosrm, client, while_asleep, action, kind, message, code
):
    """The first such event after the request counts; an older one does not."""
    client.processes = [process("a", "stuck", reason="alpha is lost")]
    client.events = [event(1, kind, "a", message="of another time")]
    more = [
        event(2, "migration_step", "a", message="a: step"),
        event(3, kind, "b", message="b is none of ours"),
        event(4, kind, "a", message=message),
    ]
    while_asleep({"events": client.events + more})
    result = rosrm(action, "a", "--wait")
    assert result.code == code
    assert "a is stuck: alpha is lost" in result.err
    assert message in (result.err if code else result.out)
    assert "another time" not in result.out + result.err


@pytest.mark.parametrize(
    ("rows", "said"),
    [([process("a", "finished", kind="job")], "a has finished"), ([], "a is no longer listed")],
)
def test_wait_ends_when_nothing_is_left_to_migrate(rosrm, client, rows, said):
    """Exit with 1 when the process has ended or was removed."""
    client.processes = rows
    result = rosrm("migrate", "a", "--wait")
    assert (result.code, result.err) == (1, f"rosrm: no longer waiting: {said}\n")


def test_cancel_wait_takes_a_process_that_left_the_list_for_ended(rosrm, client):
    """Exit with 0: a process that is no longer listed does not run."""
    client.processes = []
    assert rosrm("cancel", "a", "--wait").code == 0


def test_submit_sends_every_process_of_the_file(rosrm, client, work):
    result = rosrm("submit", work)
    assert (result.code, result.out) == (0, "2 processes were queued\n")
    assert client.asked == [("submit", ["a", "b"])]


def test_submit_json_without_a_trace_is_refused(rosrm, client, work):
    """A submission has no other output that could be JSON."""
    result = rosrm("submit", work, "--json")
    assert (result.code, client.asked) == (2, [])
    assert "--json is for the output of --trace" in result.err


def test_submit_json_with_wait_is_refused(rosrm, client, work):
    """The summary of the wait would follow the JSON."""
    result = rosrm("submit", work, "--trace", "--json", "--wait")
    assert (result.code, client.asked) == (2, [])
    assert "--wait prints no JSON" in result.err


def test_submit_refuses_a_wrong_file_before_it_looks_for_a_master(rosrm, client, tmp_path):
    (tmp_path / "w.yaml").write_text("processes: [{name: a, comand: x}]", encoding="utf-8")
    result = rosrm("submit", tmp_path / "w.yaml")
    assert result.code == 2
    assert "w.yaml:1:23: unknown key 'comand'; did you mean 'command'?" in result.err
    assert client.settings is None


JOB, SERVICE = partial(process, "a", kind="job"), partial(process, "b")
ASIDE = partial(JOB, "set_aside", reason="no host has camera=front")
UNSEEN = r"not seen to be done: a \("


@pytest.mark.parametrize(
    ("before", "after", "out", "err"),
    [
        ([JOB("queued"), SERVICE("starting")], [JOB("finished"), SERVICE()],
         "1 finished, 1 running", ""),
        ([JOB("failed", reason="exit code 3"), SERVICE()], None,
         "1 failed, 1 running", "a has failed: exit code 3"),
        # a service does not restart, though it is meant to run
        ([JOB("finished"), SERVICE("finished")], None, "2 finished", "services that finished: b;"),
        # for a moment hosts still register, at the start of a cluster
        ([ASIDE(since=1.0), SERVICE()], [ASIDE(since=6.0), SERVICE()], "1 running, 1 set aside",
         "a is set aside: no host has camera=front"),
        # a job that was pruned between two looks counts as failed, unless it was seen finished
        *(([JOB(last), SERVICE("starting")], [SERVICE()], "1 running", err)
          for last, err in (("failed", UNSEEN), ("running", UNSEEN), ("finished", ""))),
    ],
    ids=["done", "failed", "ended service", "set aside", "gone failed", "gone", "gone finished"],
)  # fmt: skip
def test_submit_wait_ends_when_no_process_is_awaited(
    rosrm, client, work, while_asleep, before, after, out, err
):
    """Exit with 0 if all jobs have finished and all services run, else with 1 and the reasons."""
    client.processes = before
    while_asleep(*([{"processes": after}] if after else []))
    result = rosrm("submit", work, "--wait")
    assert (result.code, result.out.splitlines()[-1]) == (1 if err else 0, out)
    assert re.search(err, result.err) if err else not result.err
    assert "still waiting" not in result.err
    aside = "no longer waiting for a: set aside until a host registers or changes"
    assert (aside in result.err) == ("set aside" in out)


def test_submit_wait_gives_up_after_its_time(rosrm, client, work, monkeypatch):
    """The message names processes that have not ended, with reasons, and no others."""
    monkeypatch.setattr("rosrm.client.waiting.PERIOD", 0.01)
    client.processes = [
        process("a", "starting", kind="job", reason="its artifacts are fetched"),
        process("b", "finished"),
    ]  # fmt: skip
    result = rosrm("submit", work, "--wait", "--timeout", "50ms")
    assert result.code == 1
    awaited = "a (its artifacts are fetched)"
    assert f"--timeout has passed; still waiting for {awaited}\n" in result.err


def test_ctrl_c_in_a_wait_says_that_the_processes_stay(rosrm, client, work, while_asleep):
    client.processes = [process("a", "queued", kind="job")]
    while_asleep(interrupt)
    result = rosrm("submit", work, "--wait")
    assert result.code == 130
    assert result.err == (
        "rosrm: no longer waiting; the submitted processes stay queued or run (`rosrm ps`)\n"
    )


def test_submit_takes_several_files_and_the_standard_input(rosrm, client, work, monkeypatch):
    """All files form one submission: all processes are accepted, or none."""
    other = SimpleNamespace(buffer=io.BytesIO(b"processes: [{name: c, command: x}]"))
    monkeypatch.setattr("rosrm.config.documents.sys", SimpleNamespace(stdin=other))
    assert rosrm("submit", work, "-").code == 0
    assert client.asked == [("submit", ["a", "b", "c"])]


@pytest.mark.parametrize(
    ("words", "asked"),
    [(["--all"], ["a", "c"]), (["WORK"], ["a"]), (["c", "WORK"], ["c", "a"]), (["c", "c"], ["c"])],
    ids=" ".join,
)
def test_cancel_takes_all_processes_or_those_of_a_file(rosrm, client, work, words, asked):
    """Processes of a file that have ended or were never submitted are left out."""
    client.processes = [process("a"), process("c", "queued"), process("d", "failed")]
    result = rosrm("cancel", *[work if word == "WORK" else word for word in words])
    assert (result.code, client.asked[-1]) == (0, ("cancel", asked))


def test_cancel_of_what_has_ended_says_so(rosrm, client, work):
    client.processes = [process("a", "finished"), process("b", "cancelled")]
    for words in (["--all"], [work]):
        result = rosrm("cancel", *words)
        assert (result.code, result.out.startswith("no process to cancel")) == (0, True)


def test_cancel_takes_the_jobs_of_an_array(rosrm, client):
    """Those that have ended are left out; an unknown array is refused with the nearest one."""
    client.processes = [
        process("r-1", array="r"), process("r-2", "finished", array="r"), process("s"),
        process("r-3", "scheduled", array="r"),
    ]  # fmt: skip
    assert rosrm("cancel", "--array", "r").code == 0
    assert client.asked[-1] == ("cancel", ["r-1", "r-3"])
    result = rosrm("cancel", "--array", "rr")
    assert (result.code, client.asked[-1][0]) == (1, "list")
    assert "no such array: 'rr'" in result.err


@pytest.mark.parametrize("words", [[], ["--all", "a"], ["--array", "r", "a"]])
def test_cancel_needs_names_or_all_of_them(rosrm, client, words):
    result = rosrm("cancel", *words)
    assert (result.code, client.asked) == (2, [])
    assert "give names of processes or work files, --array NAME, --app NAME, or --all" in result.err


def test_cancel_wait_ends_when_all_have_ended(rosrm, client, while_asleep):
    client.processes = [process("a", "stopping"), process("b", "finished")]
    while_asleep({"processes": [process("a", "cancelled"), process("b", "finished")]})
    result = rosrm("cancel", "a", "b", "--wait")
    said = "cancelled\n1 cancelled, 1 finished\n"
    assert (result.code, result.out, result.err) == (0, said, "")


def test_cancel_wait_reports_the_end_of_each_process_once(rosrm, client):
    """The summary is not repeated if the reply has the end of each process."""
    client.processes = [process("a", "cancelled"), process("b", "cancelled")]
    client.cancel = lambda names, force: f"{len(names)} processes cancelled"
    result = rosrm("cancel", "a", "b", "--wait")
    assert (result.code, result.out, result.err) == (0, "2 processes cancelled\n", "")


def test_restart_wait_ends_when_each_runs_in_another_run(rosrm, client, while_asleep):
    """A process that had ended runs again at all; a job may have finished."""
    client.processes = [process("a"), process("b", "failed", pid=0), process("c", kind="job")]
    ended = process("c", "finished", kind="job")
    left = while_asleep(
        {"processes": [process("a"), process("b", "queued"), ended]},
        {"processes": [process("a", pid=100), process("b"), ended]},
    )
    result = rosrm("restart", "a", "b", "c", "--wait")
    assert (result.code, result.out, left) == (0, "restarted\n1 finished, 2 running\n", [])


@pytest.mark.parametrize(("left", "code"), [([], 0), ([process("driver")], 1)])
def test_drain_wait_ends_when_the_host_is_drained(rosrm, client, while_asleep, left, code):
    """Exit with 1 if a process has stayed, because turning the host off would end it."""
    client.hosts, client.processes = [host("alpha", draining=True)], [process("talker")]
    drained = event(9, "host_drained", message="alpha is drained: so and so")
    after = [host("alpha", draining=True, drained=True)]
    while_asleep({"hosts": after, "processes": left, "events": [*client.events, drained]})
    result = rosrm("drain", "alpha", "--wait")
    assert (result.code, "alpha is drained: so and so\n" in result.out + result.err) == (code, True)


def test_drain_wait_ends_when_the_host_is_uncordoned(rosrm, client):
    client.hosts = [host("alpha")]
    result = rosrm("drain", "alpha", "--wait")
    assert (result.code, result.err) == (1, "rosrm: alpha is no longer draining\n")


def test_a_wrong_timeout_is_refused_before_anything_is_submitted(rosrm, client, work):
    result = rosrm("submit", work, "--wait", "--timeout", "soon")
    assert (result.code, client.asked) == (2, [])
    assert "--timeout: 'soon' is not a number, or text such as" in result.err


@pytest.mark.parametrize(
    "words",
    [
        ["submit", "WORK"], ["cancel", "a"], ["restart", "a"], ["migrate", "a"], ["cordon", "h"],
        ["uncordon", "h"], ["drain", "h"], ["status"], ["ps"], ["hosts"], ["plugins"], ["events"],
        ["explain", "a"], ["logs", "a"], ["top"],
    ],
    ids=" ".join,
)  # fmt: skip
@pytest.mark.parametrize(
    ("error", "code"),
    [
        (Refused("there is no process 'a'"), 1),
        (NoMaster("no master answered within 2.4 s (domain 7, RMW rmw_fastrtps_cpp)"), 3),
        (KeyboardInterrupt(), 130),
    ],
    ids=["refused", "no master", "ctrl-c"],
)
def test_every_command_ends_clean_with_its_code(rosrm, client, work, words, error, code):
    client.fails = error
    result = rosrm(*[work if word == "WORK" else word for word in words])
    assert result.code == code
    assert result.err == (f"rosrm: {error}\n" if str(error) else "")
    assert "Traceback" not in result.out
    assert client.closed


def test_a_wait_outlives_a_master_that_is_away_for_a_while(rosrm, client, work, while_asleep):
    """The user reads once that the master does not answer, and once that it answers again."""
    client.processes = [process("a", "queued", kind="job"), process("b")]
    ended = [process("a", "finished", kind="job"), process("b")]
    silent = {"fails": NoMaster("the master did not answer within 10 s.")}
    while_asleep(silent, silent, silent, {"fails": None, "processes": ended})
    result = rosrm("submit", work, "--wait")
    assert (result.code, result.err.splitlines()) == (0, [
        "rosrm: the master did not answer within 10 s. Asking again until the master answers",
        "rosrm: the master answers again",
    ])  # fmt: skip


def test_a_wait_for_a_silent_master_ends_after_its_time(rosrm, client, work, monkeypatch):
    silent = NoMaster("the master did not answer")
    monkeypatch.setattr(client, "submit", lambda specs: setattr(client, "fails", silent) or "")
    monkeypatch.setattr("rosrm.client.retrying.PERIOD", 0.01)
    result = rosrm("submit", work, "--wait", "--timeout", "50ms")
    assert result.code == 3
    assert "rosrm: --timeout has passed: the master did not answer\n" in result.err
