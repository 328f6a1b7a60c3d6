"""`rosrm run`: from the words of the command line to a spec, and refusals."""

from __future__ import annotations

from pathlib import Path

import pytest

from rosrm.cli import job_run
from rosrm.cli.job_spec import job_of
from rosrm.client import retrying
from rosrm.client.client import Client
from rosrm.errors import NoMaster
from rosrm.model.rows import HostRow
from rosrm.model.values import HostDescription, Kind

from .conftest import process, resource


def host(name, **labels):
    description = HostDescription(name, 7, labels=labels)
    return HostRow(
        description, 3, "up", False, False, True, 0.1, (resource("memory"), resource("cpu")), 0
    )


@pytest.fixture
def cluster(client, monkeypatch):
    """A client whose jobs finish at once; `submitted` has the specs."""
    client.hosts = [host("desk", host="desk", room="a"), host("shelf", host="shelf", room="a")]
    client.submitted = []

    def submit(specs):
        client.submitted += specs
        client.processes = [
            process(spec.name, "failed", kind="job", exit_code=3, reason="exit code 3")
            for spec in specs
        ]
        return "1 process queued"

    monkeypatch.setattr(client, "submit", submit)
    monkeypatch.setattr(job_run._Job, "_read", lambda _job: False)
    return client


def test_all_options_reach_the_spec(rosrm, cluster):
    """The job has the needs, labels, environment and limits of the command line."""
    result = rosrm(
        "run", "--needs", "memory=200MB", "--needs", "cpu=0.5", "--name", "one", "--on", "shelf",
        "--on", "room=a", "--env", "MODE=fast", "--env", "EMPTY=", "--time-limit", "5min",
        "--working-directory", ".", "--", "tool", "--flag", "-n", "a b",
    )  # fmt: skip
    assert result.code == 3, result.err
    (spec,) = cluster.submitted
    assert (spec.name, spec.kind, spec.ros) == ("one", Kind.JOB, False)
    assert spec.command == ("tool", "--flag", "-n", "a b")
    assert spec.needs == {"memory": 200e6, "cpu": 0.5}
    assert spec.required_labels == {"host": "shelf", "room": "a"}
    assert spec.environment == {"MODE": "fast", "EMPTY": ""}
    assert spec.time_limit == 300.0
    assert spec.working_directory == str(Path.cwd())


def test_options_behind_the_program_are_its_own(rosrm, cluster):
    """The `--` may be left out."""
    rosrm("run", "ls", "--name", "x", "-l")
    assert cluster.submitted[0].command == ("ls", "--name", "x", "-l")


@pytest.mark.parametrize(
    ("program", "stem"),
    [("/usr/bin/sleep", "sleep"), ("./my tool.sh", "my_tool"), ("-", "job"), ("é.py", "_")],
)
def test_the_default_name_is_the_program_with_a_suffix(program, stem):
    """Two jobs of one program get different names."""
    names = {job_of([program], needs={}, environment={}).name for _ in range(20)}
    assert all(name.rpartition("-")[0] == stem for name in names)
    assert len(names) > 1


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ([], 2, "no command is given; write it after --"),
        (["--needs", "memory", "ls"], 2, "--needs memory: give RESOURCE=AMOUNT"),
        (["--needs", "memory=much", "ls"], 2, "--needs: needs.memory:"),
        (["--needs", "memry=1GB", "ls"], 2, "no probe reads 'memry'; did you mean 'memory'?"),
        (["--env", "MODE", "ls"], 2, "--env MODE: give NAME=VALUE"),
        (["--time-limit", "soon", "ls"], 2, "--time-limit: time_limit:"),
        (["--name", "a/b", "ls"], 2, "--name: 'a/b' cannot be the name of a process"),
        (["--on", "shef", "ls"], 1, "no such host: 'shef'; did you mean 'shelf'?"),
        (["--on", "room=b", "ls"], 2, "--on room=b: no host has this label"),
        (["--master-timeout", "long", "ls"], 2, "--master-timeout: "),
        (["--on", "", "ls"], 2, "--on: give the name of a host, or LABEL=VALUE"),
    ],
)
def test_wrong_words_are_refused(rosrm, cluster, words, code, said):
    """Nothing is submitted, and the message names the option."""
    result = rosrm("run", *words)
    assert (result.code, cluster.submitted) == (code, []), result.err
    assert said in result.err


def test_a_host_without_a_label_of_its_own_cannot_be_chosen(rosrm, cluster):
    """The message says which label to add."""
    cluster.hosts = [host("desk", room="a"), host("shelf", room="a")]
    result = rosrm("run", "--on", "shelf", "ls")
    assert result.code == 1
    assert "labels: {host: shelf}" in result.err


@pytest.mark.parametrize("given", ["0.05s", "never"])
def test_a_silent_master_ends_the_command_after_its_time(rosrm, cluster, monkeypatch, given):
    """Ctrl-C also ends a command without a bound, which reports that the job still runs."""

    def silent(*_words, **_more):
        raise NoMaster("no answer.")

    def interrupted(_seconds):
        raise KeyboardInterrupt

    submit = cluster.submit

    def submit_and_die(specs):
        monkeypatch.setattr(cluster, "list", silent)
        monkeypatch.setattr(cluster, "cancel", silent)
        return submit(specs)

    monkeypatch.setattr(cluster, "submit", submit_and_die)
    if given == "never":
        monkeypatch.setattr(retrying.time, "sleep", interrupted)
    result = rosrm("run", "--name", "one", "--master-timeout", given, "ls")
    if given == "never":
        assert "the master does not answer, so one is not cancelled" in result.err
        assert result.code == 128
        return
    assert "Asking again until the master answers" in result.err
    assert "no longer waiting for one, which may still run: `rosrm logs -f one`" in result.err
    assert result.code == 3


@pytest.mark.parametrize(
    ("end", "code", "said"),
    [
        ({"state": "finished", "exit_code": 0}, 0, ""),
        ({"state": "failed", "exit_code": 3, "reason": "exit code 3"}, 3, ""),
        ({"state": "failed", "exit_code": -9, "reason": "killed by SIGKILL"}, 137, "SIGKILL"),
        ({"state": "failed", "exit_code": None, "reason": "no such program"}, 1, "no such program"),
        ({"state": "cancelled", "exit_code": None, "reason": ""}, 1, "was cancelled"),
    ],
)  # fmt: skip
def test_the_exit_code_is_that_of_the_job(client, capsys, end, code, said):
    """A signal gives 128 + its number; a job without an exit code gives 1 and the reason."""
    job = job_run._Job(Client(connection=client), "x")
    assert job._exit_code(process("x", kind="job", **end)) == code
    assert said in capsys.readouterr().err
