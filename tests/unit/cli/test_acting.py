"""Commands that change something, and what they say when they cannot."""

from __future__ import annotations

import pytest

from rosrm.errors import NoMaster, Refused

from .conftest import event, process


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
        (
            "checkpoint",
            "checkpoint_failed",
            "a was not checkpointed and still runs on alpha: it holds a pipe",
            1,
        ),
        ("restore", "restored", "a was restored from its image on alpha", 0),
        ("restore", "restore_failed", "a stays checkpointed on alpha: a port is in use", 1),
        ("restore", "cancelled", "a cancelled; its image is removed", 1),
    ],
)
def test_wait_says_how_a_checkpoint_or_a_restore_ended(
    rosrm, client, monkeypatch, action, kind, message, code
):
    """By the first such event after it was asked for; an older one says nothing of it."""
    client.events = [event(1, kind, "a", message="of another time")]
    client.processes = [process("a", "stuck", reason="alpha is lost")]

    def later(seconds):
        client.events += [
            event(2, "migration_step", "a", message="a: step"),
            event(3, kind, "b", message="b is none of ours"),
            event(4, kind, "a", message=message),
        ]

    monkeypatch.setattr("rosrm.cli.waiting.time.sleep", later)
    result = rosrm(action, "a", "--wait")
    assert result.code == code
    assert "a is stuck: alpha is lost" in result.err
    assert message in (result.err if code else result.out)
    assert "another time" not in result.out + result.err


def test_submit_sends_every_process_of_the_file(rosrm, client, work):
    result = rosrm("submit", work)
    assert (result.code, result.out) == (0, "2 processes were queued\n")
    assert client.asked == [("submit", ["a", "b"])]


def test_submit_refuses_a_wrong_file_before_it_looks_for_a_master(rosrm, client, tmp_path):
    (tmp_path / "w.yaml").write_text("processes: [{name: a, comand: x}]", encoding="utf-8")
    result = rosrm("submit", tmp_path / "w.yaml")
    assert result.code == 2
    assert "w.yaml:1:23: unknown key 'comand'; did you mean 'command'?" in result.err
    assert client.settings is None


def test_submit_wait_ends_when_jobs_have_ended_and_services_run(rosrm, client, work, monkeypatch):
    client.processes = [process("a", "queued", kind="job"), process("b", "starting")]

    def later(seconds):
        client.processes = [process("a", "finished", kind="job"), process("b", "running")]

    monkeypatch.setattr("time.sleep", later)
    result = rosrm("submit", work, "--wait")
    assert result.code == 0
    assert result.out.endswith("1 finished, 1 running\n")


def test_submit_wait_fails_with_the_reason_when_a_process_failed(rosrm, client, work):
    client.processes = [
        process("a", "failed", kind="job", reason="exit code 3"),
        process("b", "running"),
    ]
    result = rosrm("submit", work, "--wait")
    assert result.code == 1
    assert "a has failed: exit code 3" in result.err


def test_submit_wait_gives_up_after_its_time(rosrm, client, work, monkeypatch):
    monkeypatch.setattr("rosrm.cli.waiting.PERIOD", 0.01)
    client.processes = [process("a", "set_aside", kind="job", reason="no host has camera=front")]
    result = rosrm("submit", work, "--wait", "--timeout", "50ms")
    assert result.code == 1
    assert "a is set aside: no host has camera=front" in result.err
    assert "the time is up; still waiting for a" in result.err


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
