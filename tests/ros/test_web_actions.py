"""Requests that act, sent to `rosrm web --allow-actions` of a real cluster."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.ros.clusters import host, service
from tests.ros.web_kit import gateway
from tests.waiting import wait_until

OPERATOR, VIEWER = "o" * 32, "v" * 32
QUICK = {"interrupt_grace": "0.5s", "terminate_grace": "0.5s"}


@pytest.fixture(scope="module")
def cluster(make_shared):
    return make_shared(host("robot-1"), host("robot-2"))


@pytest.fixture(scope="module")
def web(cluster):
    """Return a gateway with an operator and a viewer."""
    file = cluster.directory / "tokens"
    file.touch(0o600)
    file.write_text(f"operator ada {OPERATOR}\nviewer eve {VIEWER}\n")
    with gateway(cluster.ros, "--tokens", str(file), "--allow-actions") as one:
        wait_until(
            lambda: one.ask("/v1/hosts", Authorization=f"Bearer {VIEWER}").status == 200,
            "the gateway finds the master",
        )
        yield one


@pytest.fixture(scope="module")
def post(web):
    """Return a function that sends a request of the operator, and returns the answer."""

    def post(path, body, token=OPERATOR, **headers):
        return web.ask(f"/v1/{path}", body, Authorization=f"Bearer {token}", **headers)

    return post


def test_a_work_file_is_submitted_and_its_process_moved_and_cancelled(cluster, post):
    """JSON with the keys of work.yaml; the answers are the master's messages."""
    work = {
        "processes": [{
            "name": "mover", "command": ["sleep", "1000"], "migration": "relaunch", "stop": QUICK,
        }]
    }  # fmt: skip

    assert "queued" in post("submit", work).json["message"]
    row = cluster.wait("mover", "running")
    (other,) = {"robot-1", "robot-2"} - {row.host}
    assert post("move", {"process": "mover", "host": other}).status == 200
    cluster.wait("mover", "running", host=other)
    assert post("cancel", {"processes": ["mover"]}).status == 200
    cluster.ended("mover")


def test_an_application_is_planned_applied_and_cancelled(cluster, post):
    """YAML as `rosrm apply` reads it; a plan begins nothing."""
    work = f"app: nav\nprocesses:\n  - {{name: planner, command: sleep 1000, stop: {QUICK}}}\n"
    yaml = {"Content_Type": "application/yaml"}

    planned = post("plan", work, **yaml).json
    assert [(one["process"], one["action"]) for one in planned["actions"]] == [("planner", "start")]
    assert not cluster.client.list(applications=True).applications
    assert post("apply", work, **yaml).status == 200
    cluster.wait("planner", "running", application="nav")
    assert post("cancel-app", {"application": "nav"}).status == 200
    cluster.ended("planner")


def test_a_host_is_cordoned_and_drained(web, post):
    """The listing after the answer has the new state."""

    def state():
        rows = web.ask("/v1/hosts", Authorization=f"Bearer {VIEWER}").json
        return [(one["cordoned"], one["draining"]) for one in rows if one["name"] == "robot-2"]

    for action, expected in (
        ("cordon", (True, False)), ("drain", (True, True)), ("uncordon", (False, False)),
    ):  # fmt: skip
        assert post(action, {"host": "robot-2"}).status == 200
        assert state() == [expected]


@pytest.mark.parametrize(
    ("path", "body", "status", "says"),
    [
        ("cancel", {"processes": ["nobody"]}, 404, "nobody"),
        ("cancel", {"processes": []}, 422, "processes"),
        ("cancel", {"processes": "nobody"}, 422, "processes"),
        ("cancel", {"processes": ["x"], "force": True}, 422, "force"),
        ("cancel", "{", 422, ""),
        ("move", {"process": "x" * 300}, 422, "process"),
        ("drain", {"host": "robot-9"}, 404, "robot-9"),
        ("submit", {"processes": [{"name": "x"}]}, 422, "work: "),
        ("submit", "[" * 100_000, 422, ""),
        ("submit", '{"processes": 1', 422, "unreadable JSON"),
        ("submit", b"\xff", 422, "UTF-8"),
        ("apply", {"processes": [{"name": "x", "command": "true"}]}, 422, "app: the name"),
        ("revert", {"application": "nav", "version": 0}, 422, "version"),
        (
            "submit",
            {"processes": [{"name": "x", "command": "true", "artifacts": {"s": "/etc/shadow"}}]},
            422, "cannot name files of the gateway's machine",
        ),
    ],
)  # fmt: skip
def test_a_bad_request_is_refused_with_a_sentence(post, path, body, status, says):
    """Nothing is changed, and no file of the gateway's machine is looked at."""
    answer = post(path, body)

    assert (answer.status, answer.headers["content-type"]) == (status, "application/problem+json")
    assert says in answer.json["detail"], answer.json


def test_a_work_file_needs_its_content_type(post):
    """A form of a foreign page cannot send it."""
    assert post("submit", "processes: []", Content_Type="text/plain").status == 422


def test_a_viewer_cannot_act_and_a_stranger_cannot_read(cluster, web, post):
    """Nothing of the request reaches the master."""
    cluster.submit(service("stays"))
    body = {"processes": ["stays"]}

    assert post("cancel", body, VIEWER).status == 403
    assert post("cancel", body, "x" * 32).status == 401
    assert web.ask("/v1/status").status == 401
    assert cluster.wait("stays", "running")
    assert not any(OPERATOR in line or VIEWER in line for line in web.said)


def test_the_log_names_who_acted(web, post):
    """A line for each request that acts."""
    post("uncordon", {"host": "robot-1"})

    wait_until(
        lambda: any("ada: POST '/v1/uncordon': 200" in line for line in web.said),
        "the gateway logs the request",
        seen=lambda: web.said,
    )


def test_tokens_that_others_can_read_are_refused(cluster, web):
    """The command ends with one sentence, before it listens."""
    file = cluster.directory / "open"
    file.write_text(f"viewer eve {VIEWER}\n")
    file.chmod(0o644)
    done = subprocess.run(
        [sys.executable, "-m", "rosrm.cli", "web", "--tokens", str(file)], capture_output=True,
        text=True, check=False, env=dict(os.environ),
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.startswith(f"rosrm: --tokens {file}: other users can read")
