"""`rosrm web` against a real cluster, over real HTTP."""

from __future__ import annotations

import itertools
import signal
from contextlib import ExitStack
from typing import Any

import pytest
from pydantic import TypeAdapter

from rosrm.archive.layout import Source
from rosrm.archive.retention import ArchiveLimits
from rosrm.archive.writer import ArchiveWriter
from rosrm.model.rows import LogPart
from rosrm_web.access import Access
from rosrm_web.app import routes
from rosrm_web.changes import MOST_READERS
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
    with gateway(cluster.ros) as one:
        one.wait_for_master("up")
        yield one


def answers() -> dict[str, Any]:
    """Return the types of the answers of all GET routes, by path."""
    listed = [one for one in routes(Gateway(None), Access()) if one.method == "GET" and one.answer]
    return {one.path: one.answer for one in listed}


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


def test_collected_output_is_shown_where_its_host_is_gone(cluster, tmp_path):
    """The notes say where it is from."""
    part = LogPart(1, (1,), b"motor stalled\n", 0, 14, True, ())
    writer = ArchiveWriter(tmp_path / "archive", ArchiveLimits(1 << 30, 1 << 30))
    writer.add(Source("robot-9", "old", 1), part)
    with gateway(cluster.ros, "--archive", str(tmp_path / "archive")) as one:
        one.wait_for_master("up")
        answer = one.get("/v1/logs/old")
    assert [chunk["text"] for chunk in answer["chunks"]] == ["motor stalled\n"]
    assert "Its output there is read from" in answer["notes"][0]


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


def test_changes_are_streamed_as_they_happen(cluster, web):
    """The stream begins with the master's state, then has each new event once, in order."""
    with web.follow() as changes:
        assert next(changes).kind == "master"
        cluster.run(job("short", "true"))
        seen = list(itertools.takewhile(lambda one: one.data["kind"] != "finished", changes))
    ours = [one.data["kind"] for one in seen if one.data.get("process") == "short"]
    assert ours[:2] == ["submitted", "assigned"]
    assert sorted({one.number for one in seen}) == [one.number for one in seen]

    with web.follow(**{"Last-Event-ID": str(seen[0].number)}) as again:
        assert [one.kind for one in itertools.islice(again, 2)] == ["master", "event"]
        assert next(again).number == seen[2].number


def test_too_many_readers_of_changes_are_refused(web):
    """The next one gets a sentence, and a place is free when a reader has left."""
    with ExitStack() as stack:

        def follow_one_more() -> bool:
            try:  # the readers of former tests may not have left yet
                return next(stack.enter_context(web.follow())).kind == "master"
            except AssertionError:
                return False

        for _ in range(MOST_READERS):
            wait_until(follow_one_more, "a place for a reader")
        answer = web.ask("/v1/changes")
        assert (answer.status, "readers" in answer.json["detail"]) == (503, True)

    with ExitStack() as stack:
        wait_until(follow_one_more, "a place for a reader is free again")


def test_the_gateway_says_that_the_master_is_lost_and_finds_the_next_one(make_cluster):
    """Without a master the gateway answers 503 with the reason, and recovers alone."""
    made = make_cluster(host("robot-1"))
    with gateway(made.ros) as web:
        web.wait_for_master("up")
        with web.follow() as changes:
            assert next(changes) == ("master", 0, {"state": "up", "reason": ""})
            made.end(made.master, signal.SIGKILL)
            lost = next(one.data for one in changes if one.kind == "master")
            assert (lost["state"], "not answered" in lost["reason"]) == ("lost", True)
        answer = web.ask("/v1/processes")
        assert (answer.status, "master" in answer.json["detail"]) == (503, True)

        with web.follow() as changes:
            assert next(changes).data["state"] == "lost"
            made.reconnect()
            made.start_master()
            assert next(one.data["state"] for one in changes if one.kind == "master") == "up"
        wait_until(lambda: web.ask("/v1/hosts").status == 200, "the hosts are listed again")


def test_nothing_notices_the_death_of_a_gateway(cluster):
    """The master and its slaves work as before."""
    with gateway(cluster.ros) as web:
        web.wait_for_master("up")
        assert web.end(signal.SIGKILL) == -signal.SIGKILL
        cluster.run(job("after", "true"))
