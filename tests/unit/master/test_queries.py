"""Queries to the master: failing plugins with their last error, and bounded pages of events."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from rosrm.core.master import events as happened
from rosrm.errors import PluginError
from rosrm.journal.sqlite import SqliteJournal
from rosrm.master.queries import MasterQueries
from rosrm.model.requester import OPERATOR, Requester
from rosrm.model.rows import PluginRow
from rosrm_msgs import srv
from tests.unit.core.cluster import Cluster, Machine, job, process

SELECTED = PluginRow("scoring", "eq1", "mine 1.0", "selected", "the summary")


def rows(cluster: Cluster, *, failing: bool = False) -> list[PluginRow]:
    """Return the rows of `rosrm plugins`, or those that `rosrm status` requests."""
    reading = MasterQueries(
        "m", cluster.state, SimpleNamespace(last_sequence=0), [SELECTED],
        uptime=lambda: 0.0, core_now=lambda: cluster.now, trouble=lambda: "",
    )  # fmt: skip
    asked = srv.List.Request(plugins=True, failing=failing)
    return list(reading.snapshot(asked, OPERATOR).plugins)


def named(cluster: Cluster, name: str) -> PluginRow:
    return next(row for row in rows(cluster) if row.name == name)


@pytest.mark.parametrize(
    ("after", "most", "wanted"),
    [(3, 7, (3, 7)), (0, 0, (0, 1000)), (2**64 - 1, 2**32 - 1, (2**53, 10_000))],
)
def test_a_page_of_events_is_bounded(after: int, most: int, wanted: tuple[int, int]) -> None:
    """Greater numbers would overflow the journal's, or answer with all events at once."""
    asked = []
    journal = SimpleNamespace(
        last_sequence=0,
        records=lambda *, after, newest, **_: asked.append((after, newest)) or (),
    )
    queries = MasterQueries(
        "m", Cluster().state, journal, [],
        uptime=lambda: 0.0, core_now=lambda: 0.0, trouble=lambda: "",
    )  # fmt: skip
    request = srv.List.Request(events=True, after_sequence=after, max_events=most)
    assert queries.snapshot(request, OPERATOR).events == []
    assert asked == [wanted]


def test_a_plugin_that_works_is_shown_as_the_registry_has_it() -> None:
    """The row has its summary, and for a probe its scope."""
    cluster = Cluster("a")
    assert named(cluster, "eq1") == SELECTED
    assert (named(cluster, "cpu").state, named(cluster, "cpu").host) == ("selected", "a")


def test_a_policy_that_fails_is_shown_as_failing() -> None:
    """The row has the hook and the last error."""
    cluster = Cluster("a")
    with pytest.raises(PluginError):
        cluster.state.plugins.ask("scoring", "eq1", "score", lambda: 1 / 0)
    cluster.wait(0.1)
    row = named(cluster, "eq1")
    assert row.state == "failing"
    assert row.reason.startswith("score: ZeroDivisionError: division by zero (")
    assert rows(cluster, failing=True) == [row]


def test_a_policy_that_worked_since_its_failure_is_shown_so() -> None:
    """The row has the age of the last failure, and says that a call has succeeded since."""
    cluster = Cluster("a")
    with pytest.raises(PluginError):
        cluster.state.plugins.ask("scoring", "eq1", "score", lambda: 1 / 0)
    cluster.wait(3.0)
    assert named(cluster, "eq1").reason.endswith("; 1 failure so far, the last 2.9 s ago")
    cluster.state.plugins.ask("scoring", "eq1", "score", lambda: "scores")
    cluster.wait(1.0)
    assert named(cluster, "eq1").reason.endswith("the last 3.9 s ago; it has succeeded since")
    cluster.wait(10.0)
    assert named(cluster, "eq1").state == "selected"


def test_a_probe_that_fails_is_shown_as_failing_on_its_host() -> None:
    """The row has the slave's reason until a report without it."""
    cluster = Cluster("a", "b")
    machine = cluster.machines["a"]
    for failing, state in (({"cpu": "probe cpu: unplugged"}, "failing"), ({}, "selected")):
        machine.batches += 1
        cluster.tell(
            happened.StatusesReceived(
                machine.host_id, machine.incarnation, machine.batches, False, (), failing
            )
        )
        states = {row.host: row.state for row in rows(cluster) if row.name == "cpu"}
        assert states == {"a": state, "b": "selected"}
        fails = [("cpu", "a")] if failing else []
        assert [(row.name, row.host) for row in rows(cluster, failing=True)] == fails


@pytest.mark.parametrize(
    ("by", "details"),
    [
        (Requester("user:ada"), True),
        (OPERATOR, True),
        (Requester("user:bob"), False),
        (Requester(), False),
    ],
)
def test_environment_and_parameters_are_shown_to_owner_and_operators(
    tmp_path: Path, by: Requester, *, details: bool
) -> None:
    """Nothing that another user can read has a value of them, in a sentence or in its details."""
    refusal = "program 'p' is not on the PATH\nthe PATH is /secret/bin"
    cluster = Cluster(Machine("a", refuses={"p": refusal}), Machine("b", refuses={"q": refusal}))
    spec = process("p", environment={"PATH": "/secret/bin"}, parameters={"key": "/secret/key"})
    cluster.ask(happened.SubmissionReceived, (spec, process("q")), Requester("user:ada"))
    cluster["q"].reason = refusal
    journal = SqliteJournal(tmp_path / "journal.sqlite")
    journal.write(cluster.records, [], 0.0)
    queries = MasterQueries(
        "m", cluster.state, journal, [],
        uptime=lambda: 0.0, core_now=lambda: cluster.now, trouble=lambda: "",
    )  # fmt: skip
    request = srv.List.Request(events=True, processes=True, hosts=True, plugins=True)
    listed = queries.snapshot(request, by)
    journal.close()
    story = queries.explain("p", by)
    assert story is not None
    messages = [row.message for row in listed.events] + [
        one["message"] for one in json.loads(story)["history"]
    ]
    assert sum("not on the PATH" in message for message in messages) >= 2
    joined = "not on the PATH; the PATH is /secret/bin"
    assert any(joined in message for message in messages) is details
    assert (joined in story) is details
    reasons = {row.name: row.reason for row in listed.processes}
    assert reasons["q"] == (refusal if details else refusal.partition("\n")[0])
    assert ("secret" in f"{listed} {story} {queries.explain('q', by)}") is details
    assert "/secret/key" not in f"{listed} {story}"


def test_a_new_owner_of_a_name_reads_no_log_of_the_former_owner() -> None:
    """The owner reads the logs of all its own submissions in a row, an operator those of all."""
    ada, bob = Requester("user:ada"), Requester("user:bob")
    cluster = Cluster("a")
    queries = MasterQueries(
        "m", cluster.state, SimpleNamespace(last_sequence=0), [],
        uptime=lambda: 0.0, core_now=lambda: cluster.now, trouble=lambda: "",
    )  # fmt: skip

    def run(by: Requester) -> int:
        """Submit the process, run it to its end, and return the number of its instance."""
        assert cluster.ask(happened.SubmissionReceived, (job("p"),), by).accepted
        number = cluster["p"].owner
        cluster.finish("p")
        return number

    adas = [run(ada), run(ada)]
    assert queries.first_readable_log("p", ada) <= min(adas)
    assert queries.first_readable_log("p", bob) is None
    assert cluster.ask(happened.PruneRequested, ("p",), (), OPERATOR).accepted
    assert [queries.first_readable_log("p", by) for by in (ada, bob, OPERATOR)] == [None, None, 0]
    bobs = run(bob)
    assert max(adas) < queries.first_readable_log("p", bob) <= bobs
    assert queries.first_readable_log("p", ada) is None
    assert queries.first_readable_log("p", OPERATOR) == 0
