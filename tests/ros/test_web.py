"""`rosrm web` against a real cluster, over real HTTP."""

from __future__ import annotations

import signal
from typing import Any

import pytest
from pydantic import TypeAdapter

from rosrm_web.app import routes
from rosrm_web.gateway import Gateway
from tests.ros.clusters import host, job, service
from tests.ros.web_kit import gateway
from tests.waiting import wait_until


@pytest.fixture(scope="module")
def cluster(make_shared):
    """Return a cluster with a service that writes HTML."""
    made = make_shared(host("robot-1"), host("robot-2"))
    made.submit(service("talker", "sh", "-c", "echo '<b>hello</b>'; sleep 1000"))
    made.wait("talker", "running")
    made.wait_for_log("talker", "hello")
    return made


@pytest.fixture(scope="module")
def web(cluster):
    """Return a gateway that only reads."""
    with gateway(cluster) as one:
        yield one


def answers() -> dict[str, Any]:
    """Return the types of the answers of all GET routes, by path."""
    return {one.path: one.answer for one in routes(Gateway(None)) if one.method == "GET"}


@pytest.mark.parametrize("path", answers())
def test_an_answer_has_the_form_that_openapi_says(web, path):
    """Each route answers with the members of its declared type, and no others."""
    answer = web.get(path.replace("{process}", "talker"))

    TypeAdapter(answers()[path]).validate_python(answer, extra="forbid")
    assert path in web.get("/v1/openapi.json")["paths"]


def test_rows_are_those_of_the_command_line(web):
    """Hosts and processes are in the listings by their names."""
    assert {one["name"] for one in web.get("/v1/hosts")} == {"robot-1", "robot-2"}
    (talker,) = web.get("/v1/processes")
    assert (talker["name"], talker["state"]) == ("talker", "running")
    assert talker["host"] in web.get("/v1/explain/talker")["host"]
    kinds = [one["kind"] for one in web.get("/v1/events?process=talker")]
    assert kinds[0] == "submitted"


def test_a_log_is_plain_data(web):
    """HTML in a log line stays text, and no browser takes the answer for a page."""
    answer = web.ask("/v1/logs/talker?tail=5")

    assert answer.json["chunks"][-1]["text"] == "<b>hello</b>\n"
    assert answer.headers["content-type"] == "application/json"
    assert answer.headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize(
    ("path", "status", "says"),
    [
        ("/v1/explain/talkr", 404, "talker"),
        ("/v1/logs/talkr", 404, "talker"),
        ("/v1/nothing", 404, "Not Found"),
        ("/v1/../../etc/passwd", 404, "Not Found"),
        ("/v1/explain/..%2f..%2fetc%2fpasswd", 404, ""),
        ("/v1/events?newest=0", 422, "newest"),
        ("/v1/events?process=" + "x" * 300, 422, "process"),
        ("/v1/explain/" + "x" * 300, 422, "process"),
    ],
)
def test_an_error_is_a_problem_with_a_sentence(web, path, status, says):
    """Errors have the form of RFC 9457; the sentence of an unknown name suggests the nearest."""
    answer = web.ask(path)

    assert answer.status == status, answer
    assert answer.headers["content-type"] == "application/problem+json"
    assert says in answer.json["detail"]


def test_a_foreign_host_name_is_refused(web):
    """A page whose name points to this machine gets no data (DNS rebinding)."""
    assert web.ask("/v1/status", Host="evil.example").status == 421


def test_the_gateway_says_that_the_master_is_lost_and_finds_the_next_one(make_cluster):
    """Without a master the gateway stays, answers 503 with a reason, and recovers alone."""
    made = make_cluster(host("robot-1"))
    with gateway(made) as web:
        web.wait_for_master("up")
        made.end(made.master, signal.SIGKILL)
        web.wait_for_master("lost")
        answer = web.ask("/v1/processes")
        assert (answer.status, "master" in answer.json["detail"]) == (503, True)

        made.reconnect()
        made.start_master()
        web.wait_for_master("up")
        wait_until(lambda: web.ask("/v1/hosts").status == 200, "the hosts are listed again")


def test_nothing_notices_the_death_of_a_gateway(cluster):
    """The master and its slaves work as before."""
    with gateway(cluster) as web:
        web.wait_for_master("up")
        assert web.end(signal.SIGKILL) == -signal.SIGKILL
        cluster.run(job("after", "true"))
