"""Commands that show something: tables for 80 columns, and stable JSON."""

from __future__ import annotations

import json
import re
import time
from dataclasses import replace

import pytest

from rosrm.cli.output import explain, tables
from rosrm.errors import NoMaster, Refused
from rosrm.model.rows import DeviceRow, PluginRow

from .conftest import (
    EVENTS,
    NAN,
    PLUGINS,
    STORY,
    FakeClient,
    event,
    host,
    interrupt,
    process,
    resource,
)


def test_status_shows_the_cluster_on_half_a_page(rosrm, client):
    result = rosrm("status")
    assert result.code == 0
    lines = result.out.splitlines()
    assert lines[0] == "master     lab, up 2 min"
    assert lines[1] == "hosts      2 up, 1 suspect (1 cordoned, 1 draining)"
    assert lines[2] == "processes  1 running, 1 queued, 1 failed, 1 finished"
    assert "crashed has failed" in result.out
    assert "talker goes to alpha" in result.out


@pytest.mark.parametrize("command", ["status", "hosts"])
def test_a_host_that_processes_have_to_leave_is_explained(rosrm, client, command):
    """Four hosts, because each explanation is a request."""
    client.to_leave = ["it is over its limit of memory: nothing can leave it"]
    client.hosts = [host("fine", resources=[resource("memory")])]
    assert "over its limit" not in rosrm(command).out
    client.hosts = [host(f"h{n}") for n in range(6)]
    out = " ".join(rosrm(command).out.split())
    assert out.count(client.to_leave[0]) == 4
    assert "`rosrm explain HOST` explains h4, h5" in out


def test_explain_takes_a_host_if_no_process_has_the_name(rosrm, client):
    client.unknown = {"alpha"}
    client.to_leave = ["alpha is being drained: p leaves"]
    assert rosrm("explain", "alpha").out == "alpha is being drained: p leaves\n"
    assert json.loads(rosrm("explain", "alpha", "--json").out)["of_host"] == "alpha"
    client.to_leave = []
    assert rosrm("explain", "alpha").out == "no process has to leave alpha\n"


def test_the_columns_of_resources_do_not_move(rosrm, client):
    """A probe that is late registers last."""
    client.hosts = [host("a", resources=[resource("memory"), resource("cpu")])]
    assert rosrm("hosts").out.splitlines()[0].split()[3:] == ["cpu", "%", "memory", "%"]


def test_hosts_with_devices_show_the_free_ones(rosrm, client):
    """Shares of units count; missing units are named, and only listed in a column of their own."""
    assert "DEVICES" not in rosrm("hosts").out
    devices = (
        DeviceRow("camera", "front", free=1.0),
        DeviceRow("camera", "rear", missing="gone"),
        DeviceRow("gpu", "0", free=0.25, holders=("p#1",)),
        DeviceRow("gpu", "1", free=1.0),
    )
    client.hosts = [replace(host("alpha"), devices=devices), host("beta")]
    lines = rosrm("hosts").out.splitlines()
    assert lines[0].endswith("FREE DEVICES")
    assert "camera 1/2 (rear missing), gpu 1.25/2" in lines[2]
    (alpha, beta) = json.loads(rosrm("hosts", "--json").out)
    assert alpha["devices"][2] == {
        "kind": "gpu", "unit": "0", "path": "", "shareable": 1, "about": "", "missing": "",
        "free": 0.25, "holders": ["p#1"],
    }  # fmt: skip
    assert beta["devices"] == []


def test_status_json_counts_states(rosrm, client):
    assert json.loads(rosrm("status", "--json").out) == {
        "master": "lab", "uptime": 125.0, "last_sequence": 2, "trouble": "", "security": "keys",
        "strangers": "", "to_leave": [],
        "hosts": {"up": 2, "suspect": 1}, "failing_plugins": [],
        "processes": {"running": 1, "queued": 1, "failed": 1, "finished": 1},
    }  # fmt: skip


def test_status_shows_what_is_not_protected(rosrm, client):
    """A cluster without keys, and messages of strangers; otherwise neither is mentioned."""
    assert "security" not in rosrm("status").out
    client.security, client.strangers = "none", "3 messages without a valid key refused"
    lines = rosrm("status").out.splitlines()
    assert lines[1] == "security   none: every participant of this ROS domain has all rights"
    assert lines[2] == "strangers  3 messages without a valid key refused"


def test_status_names_the_plugins_that_fail(rosrm, client):
    """The output has the host and the last error, and no working plugins."""
    client.plugins = [
        PluginRow("scoring", "affine", "mine 1.0", "failing", "score: KeyError: 'x' (a.py:3)"),
        PluginRow("probe", "lidar", "", "failing", "no such sensor", "shelf"),
        PluginRow("probe", "cpu", "", "selected", "scope machine", "shelf"),
    ]
    out = rosrm("status").out
    assert "plugin scoring affine is failing: score: KeyError: 'x' (a.py:3)" in out
    assert "plugin probe lidar on shelf is failing: no such sensor" in out
    assert "probe cpu" not in out
    failing = json.loads(rosrm("status", "--json").out)["failing_plugins"]
    assert [row["name"] for row in failing] == ["affine", "lidar"]


@pytest.mark.parametrize("command", ["status", "ps", "hosts", "events"])
@pytest.mark.parametrize("json_too", [(), ("--json",)])
def test_a_master_that_accepts_no_work_is_reported_beside_the_listing(
    rosrm, client, command, json_too
):
    whole = rosrm(command, *json_too)
    client.trouble = "the master accepts no new work: the disk is full"
    result = rosrm(command, *json_too)
    assert result.code == 0
    assert result.err == "rosrm: the master accepts no new work: the disk is full\n"
    if not json_too:
        assert result.out == whole.out


def test_ps_of_an_array_has_a_summary(rosrm, client):
    """The failed jobs are named with their reasons, also in JSON."""
    client.processes = [
        process("r-1", "finished", array="r"), process("r-2", "finished", array="r"),
        process("r-3", "failed", exit_code=2, array="r"), process("s"),
    ]  # fmt: skip
    lines = rosrm("ps", "--array", "r").out.splitlines()
    assert lines[0] == "3: 2 finished, 1 failed (r-3: exit code 2)"
    assert not any("s " in line.split("  ") for line in lines)
    found = json.loads(rosrm("ps", "--array", "r", "--json").out)
    assert (found["array"], found["summary"]) == ("r", lines[0])
    assert found["states"] == {"finished": 2, "failed": 1}
    assert [row["name"] for row in found["processes"]] == ["r-1", "r-2", "r-3"]
    assert "no such array: 'q'; there are: r" in rosrm("ps", "--array", "q").err


def test_ps_shows_when_a_job_runs_again(rosrm, client):
    """The reason has the time; JSON has it as unix time."""
    why = "next run at 02:00 UTC (in 5 h); its last run failed: exit code 2"
    client.processes = [process("p", "scheduled", reason=why, next_run=1.8e9, exit_code=2)]
    assert why in rosrm("ps").out
    (row,) = json.loads(rosrm("ps", "--json").out)
    assert (row["next_run"], row["exit_code"]) == (1.8e9, 2)


def test_ps_leaves_out_terminal_processes_and_counts_them(rosrm, client):
    out = rosrm("ps").out
    assert "done" not in out
    assert "1 finished or cancelled (--all shows them)" in out
    assert "done" in rosrm("ps", "--all").out


@pytest.mark.parametrize(
    ("command", "shown"),
    [
        ("ps", ["64.0 MB", "2 restarts; moved 1x", "exit code 3",
                "no. 1 in the queue; no host has room: memory"]),
        ("hosts", ["memory %", "40/80", "95/90", "suspect, cordoned", "up, draining"]),
        ("plugins", ["no NVIDIA driver", "rosrm-scoring 0.1.0"]),
    ],
)  # fmt: skip
def test_a_listing_shows_values_and_reasons(rosrm, client, command, shown):
    out = rosrm(command).out
    assert [text for text in shown if text not in out] == []


def test_ps_of_one_host(rosrm, client):
    out = rosrm("ps", "--host", "alpha").out
    assert "talker" in out
    assert "next" not in out


def test_an_empty_cluster_and_a_drained_host(rosrm, client):
    client.hosts, client.processes, client.events = [], [], []
    assert rosrm("ps").out == "no process\n"
    assert rosrm("hosts").out == "no host; start `rosrm slave` on each\n"
    assert rosrm("status").out.splitlines()[1:3] == ["hosts      none", "processes  none"]
    client.hosts = [host("a", draining=True, drained=True)]
    assert "up, drained" in rosrm("hosts").out
    assert "(1 drained)" in rosrm("status").out


def test_ps_json_has_every_process_with_every_field(rosrm, client):
    rows = json.loads(rosrm("ps", "--json").out)
    assert [row["name"] for row in rows] == ["talker", "next", "crashed", "done"]
    assert rows[0] == {
        "name": "talker", "kind": "service", "state": "running", "host": "alpha", "number": 1,
        "pid": 99, "restarts": 2, "migrations": 1, "exit_code": 0, "priority": 0,
        "queue_position": 0, "since": 12.0, "cpu": 0.5, "memory": 64_000_000, "reason": "",
        "stale": False, "owner": "", "cpu_limit": 0.0, "memory_limit": 0, "array": "",
        "next_run": 0.0, "application": "",
    }  # fmt: skip


def test_a_stale_or_missing_reading_is_marked(rosrm, client):
    """The table marks it by `?`, JSON by `stale`."""
    stale, missing = resource("memory", stale=True), resource("cpu", usage=NAN)
    client.hosts = [host("a", resources=[stale]), host("b", resources=[missing])]
    client.processes = [process("p", "unreachable", pid=9, stale=True, reason="alpha is lost")]
    for command, shown in (("hosts", ("?40/80", "?/80")), ("ps", ("?0.50", "?64.0 MB"))):
        out = rosrm(command).out
        assert [text for text in shown if text not in out] == []
    (row,) = json.loads(rosrm("ps", "--json").out)
    assert row["stale"] is True


@pytest.mark.parametrize("command", ["status", "ps", "hosts", "plugins", "explain"])
def test_a_table_in_a_pipe_has_no_blanks_at_the_ends_of_its_lines(rosrm, client, command):
    out = rosrm(command, *(["talker"] if command == "explain" else [])).out
    assert [line for line in out.splitlines() if line != line.rstrip()] == []


def test_hosts_json_joins_host_and_description_and_has_no_nan(rosrm, client):
    client.hosts = [host("a", resources=[resource("memory", usage=NAN)])]
    (row,) = json.loads(rosrm("hosts", "--json").out)
    assert (row["name"], row["state"], row["labels"]) == ("a", "up", {"gpu": "true"})
    assert row["resources"] == [{
        "name": "memory", "unit": "B", "capacity": 2e9, "scope": "machine", "usage": None,
        "in_flight": 0.1, "limit": 0.8, "stale": False,
    }]  # fmt: skip


def test_plugins_json_has_every_plugin_with_every_field(rosrm, client):
    rows = json.loads(rosrm("plugins", "--json").out)
    assert rows[1] == {
        "kind": "probe", "name": "gpu", "distribution": "rosrm-resources 0.1.0",
        "state": "absent", "reason": "no NVIDIA driver", "host": "alpha",
    }  # fmt: skip
    assert len(rows) == len(PLUGINS)


def test_plugins_local_asks_no_master(rosrm, client):
    client.fails = NoMaster("none")
    assert rosrm("plugins", "--local").code == 0
    assert client.asked == []


def test_events_are_shown_oldest_first(rosrm, client):
    result = rosrm("events", "--process", "talker", "--newest", 10)
    clock = time.strftime("%H:%M:%S", time.localtime(1_700_000_000))
    assert result.out.splitlines()[1] == f"{clock}  assigned           talker goes to alpha"
    assert client.asked == [("list", {"process": "talker", "host": "", "after": 0, "newest": 10})]


def test_events_follow_outlives_a_master_that_is_away_for_a_while(rosrm, client, while_asleep):
    """The output continues after the newest event shown before."""
    silent = {"fails": NoMaster("the master did not answer")}
    while_asleep(silent, {"fails": None, "events": [*EVENTS, event(3)]}, interrupt)
    result = rosrm("events", "-f")
    assert (result.code, len(result.out.splitlines())) == (130, 3)
    assert result.err.count("\n") == 2
    assert "rosrm: the master answers again\n" in result.err


def test_events_json_is_one_list(rosrm, client):
    rows = json.loads(rosrm("events", "--json").out)
    assert [row["sequence"] for row in rows] == [1, 2]
    assert rows[0] == {
        "sequence": 1, "wall_time": 1_700_000_000.0, "elapsed": 1.5, "kind": "submitted",
        "process": "talker", "host": "", "message": EVENTS[0].message, "facts": {"score": 0.4},
    }  # fmt: skip


def test_events_follow_shows_each_event_once_until_ctrl_c(rosrm, client, while_asleep):
    more = {"events": [*EVENTS, event(3)]}
    while_asleep(more, {}, {"events": [*more["events"], event(4)]}, interrupt)
    result = rosrm("events", "-f", "--json")
    assert result.code == 130
    assert [json.loads(line)["sequence"] for line in result.out.splitlines()] == [1, 2, 3, 4]


def test_explain_shows_every_host_with_its_score_or_veto(rosrm, client):
    out = rosrm("explain", "talker").out
    lines = out.splitlines()
    assert lines[0] == "talker is running on alpha"
    assert lines[2].startswith(
        "The master assigned talker to alpha 61 s ago. Scoring policy: weighted;"
    )
    assert "Needs, declared or estimated: memory 64.0 MB, cpu 0.5 cores." in out
    for expected in ("0.4123", "memory 0.79 of 0.8", "too near its limit", "vetoed"):
        assert expected in out
    assert "and 5 more hosts cannot take it now" in out
    assert "at a higher score" not in out
    assert "62 s ago  submitted          talker was submitted" in out


def test_explain_shows_the_owner_if_it_is_known():
    assert drawn(explain.render({**STORY, "owner": "user:ada"}))[1] == "Owner: user:ada"
    assert "Owner" not in "".join(drawn(explain.render({**STORY, "owner": ""})))


def test_explain_shows_what_comes_from_the_defaults_of_the_cluster():
    given = {"restart.when": "always", "environment": None, "needs": {"memory": 2e8}}
    lines = drawn(explain.render({**STORY, "defaults": given}))
    said = 'From `defaults.process` of the cluster: restart.when "always", environment, needs'
    assert said in " ".join(lines)
    assert "defaults.process" not in "".join(drawn(explain.render({**STORY, "defaults": {}})))


def test_explain_shows_limits_and_whether_they_hold():
    limits = {"limits.memory": {"value": "500 MB"}, "nice": {"value": "-5"}}
    expected = "Limits and scheduling: limits.memory 500 MB, nice -5."
    assert expected in drawn(explain.render({**STORY, "limits": limits}))
    limits["limits.memory"] |= {"holds": True, "reason": ""}
    held = " ".join(drawn(explain.render({**STORY, "limits": limits})))
    assert f"{expected} The host enforces them." in held
    limits["nice"] |= {"holds": False, "reason": "CAP_SYS_NICE is required"}
    unmet = " ".join(drawn(explain.render({**STORY, "limits": limits})))
    assert f"{expected} Not enforced: nice: CAP_SYS_NICE is required." in unmet
    limits["limits.memory"] |= {"used": "600 MB"}
    above = " ".join(drawn(explain.render({**STORY, "limits": limits})))
    assert "limits.memory 500 MB (earlier runs of its program used 600 MB), nice -5." in above


def flow(process: str, rate: float) -> dict[str, object]:
    """Return a measured flow from a process on beta, as a master explains it."""
    return {"process": process, "rate": rate, "incoming": True, "host": "beta", "learned": True}


def test_explain_shows_the_largest_flows_one_a_line():
    """A single flow is a sentence, and smaller flows are counted."""
    lines = drawn(explain.render({**STORY, "flows": [flow("camera", 2e6)]}))
    assert "Flows: 2.0 MB/s from camera on beta (measured)." in lines
    many = [flow(f"p{number}", 1e3 * (20 - number)) for number in range(12)]
    lines = drawn(explain.render({**STORY, "flows": many, "flows_omitted": 3}))
    at = lines.index("Flows:")
    assert lines[at + 1] == "  20.0 kB/s from p0 on beta (measured)"
    assert lines[at + 8] == "  13.0 kB/s from p7 on beta (measured)"
    assert lines[at + 9] == "  and 7 smaller flows"


def test_ps_shows_the_limits_that_hold():
    """Without any, there is no column for them."""
    other = process("other")
    rows = [process("camera", cpu_limit=1.5), process("map", memory_limit=5 * 10**8), other]
    columns = {column.header: list(column.cells) for column in tables.processes(rows).columns}
    assert columns["LIMITS"] == ["1.5 cores", "500 MB", ""]
    assert "LIMITS" not in [column.header for column in tables.processes([other]).columns]


def test_explain_prints_the_rounding_error_of_a_score_as_zero():
    host = {"name": "alpha", "verdict": "chosen", "score": 1.3877787807814457e-17}
    made = explain.render({**STORY, "decision": {**STORY["decision"], "hosts": [host]}})
    (line,) = [line for line in drawn(made) if line.startswith("alpha")]
    assert line.split() == ["alpha", "chosen", "0"]


def drawn(made, width=60):
    from io import StringIO

    from rich.console import Console

    output = StringIO()
    Console(file=output, width=width, highlight=False).print(made)
    return [line.rstrip() for line in output.getvalue().splitlines()]


LONG = "a host " * 9
WAITS = {"elapsed": 9.0, "kind": "waits", "message": LONG}


@pytest.mark.parametrize(
    "made", [explain.render({**STORY, "history": [WAITS]}), tables.event(event(1, message=LONG))]
)
def test_an_event_on_a_terminal_wraps_below_its_message(made):
    lines = drawn(made)
    first = next(i for i, line in enumerate(lines) if "a host" in line)
    indent = lines[first].index("a host")
    assert [len(line) - len(line.lstrip()) for line in lines[first + 1 :]] == [indent, indent]


@pytest.fixture
def explained(rosrm, client):
    """Return a function that gives the lines of `rosrm explain` for a changed story."""

    def lines(**changes):
        client.explain = lambda name: {**STORY, **changes}
        return rosrm("explain", "talker").out.splitlines()

    return lines


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("fits", "alpha could take talker now."), ("waits", "No host can take talker now."),
        ("set_aside", "No host may take talker."),
    ],
)  # fmt: skip
def test_explain_does_not_contradict_itself_about_a_waiting_process(explained, kind, says):
    """A host is chosen only by an assignment; the advice follows the reason."""
    decision = {**STORY["decision"], "kind": kind, "elapsed": 0.0}
    text = "\n".join(
        explained(state="queued", reason="waits for x", advice="try", decision=decision)
    )
    assert says in text
    assert ("chosen" in text) == (kind != "fits")
    assert "talker is queued on alpha: waits for x; try" in text


def test_explain_says_that_older_events_are_left_out_and_where_they_are(explained):
    assert "left out" not in "\n".join(explained())
    newer = [{"elapsed": 2.0, "kind": "ready", "message": "talker is ready on alpha"}]
    assert "Older events are left out: `rosrm events --process talker`" in explained(history=newer)


@pytest.mark.parametrize(
    ("state", "sentence"),
    [
        ("backoff", "talker is in back-off on alpha"),
        ("failed", "talker has failed on alpha"),
        ("finished", "talker has finished on alpha"),
        ("cancelled", "talker was cancelled on alpha"),
        ("set_aside", "talker is set aside on alpha"),
    ],
)
def test_a_state_is_shown_in_a_sentence(explained, state, sentence):
    assert explained(state=state)[0] == sentence


@pytest.mark.parametrize(
    ("restarts", "reason", "shown"),
    [(1, "", r"1 restart\b"), (3, "its restart policy allows 3 restarts in 300 s", "3 restarts")],
)
def test_the_number_of_restarts_is_shown_once(rosrm, client, restarts, reason, shown):
    client.processes = [process("talker", restarts=restarts, reason=reason)]
    assert len(re.findall(shown, rosrm("ps").out)) == 1


@pytest.mark.parametrize("command", ["events", "ps", "logs talker"])
def test_a_host_that_is_not_there_is_refused(rosrm, client, command):
    result = rosrm(*command.split(), "--host", "alpa")
    assert (result.code, result.out) == (1, "")
    assert result.err == (
        "rosrm: no such host: 'alpa'; did you mean 'alpha'? (`rosrm hosts` lists them)\n"
    )


def test_events_of_a_process_that_is_not_there_are_refused(rosrm, client):
    result = rosrm("events", "--process", "talkr")
    assert (result.code, result.out) == (1, "")
    assert result.err == (
        "rosrm: no such process: 'talkr'; did you mean 'talker'? (`rosrm ps --all` lists them)\n"
    )
    assert "; there are: talker, next, crashed, done (" in rosrm("events", "--process", "zzz").err


def test_events_of_a_process_without_any_are_none(rosrm, client):
    assert rosrm("events", "--process", "crashed").code == 0


def test_events_say_that_older_ones_are_left_out(rosrm, client):
    said = "rosrm: at most the newest 1 are shown; -n N shows more\n"
    assert [rosrm("events", "-n", number).err for number in (1, 3)] == [said, ""]


def test_explain_json_is_the_masters_own(rosrm, client):
    assert json.loads(rosrm("explain", "talker", "--json").out) == STORY


def test_explain_lists_the_snapshot_replicas(explained):
    kept = [{"host": "beta", "number": 7, "sequence": 120, "size": 5_000_000, "elapsed": 0.4}]
    said = "Snapshots of its state are on beta (cycle 120, 5.0 MB, 0.4 s ago)."
    assert explained(kept=kept)[1] == said


@pytest.mark.parametrize(
    ("told", "line"),
    [
        ({"elapsed": 12.0, "size": 34_000_000, "pause": 0.84, "trouble": ""},
         "The last periodic checkpoint is 12 s old (34.0 MB; the process was paused for 0.8 s)."),
        ({"elapsed": None, "size": 0, "pause": 0.0, "trouble": "no room"},
         "No periodic checkpoint of its memory exists yet: no room"),
    ],
)  # fmt: skip
def test_explain_says_when_memory_was_dumped(explained, told, line):
    assert line in explained(checkpoint=told)


def test_explain_of_a_process_without_a_decision(explained):
    undecided = {"decision": None, "history": [], "host": "", "state": "queued"}
    assert explained(**undecided, reason="2 before it") == [
        "talker is queued: 2 before it", "",
        "Older events are left out: `rosrm events --process talker`",
    ]  # fmt: skip


PIPED = ("ps", "hosts", "plugins", "status", "top -n 1")


@pytest.mark.parametrize("words", PIPED)
def test_what_is_piped_is_neither_cut_nor_wrapped(rosrm, client, words):
    reason = "because " * 90 + "of this."
    client.processes = [process(f"p{number}", reason=reason) for number in range(30)]
    client.plugins = [replace(PLUGINS[0], reason=reason)]
    out = rosrm(*words.split()).out
    assert "…" not in out
    wanted = {"ps": 30, "top -n 1": 30, "plugins": 1}.get(words, 0)
    assert len([line for line in out.splitlines() if line.endswith(reason)]) == wanted


@pytest.mark.parametrize("words", PIPED)
def test_what_is_piped_obeys_columns(rosrm, client, words):
    """Tables are wrapped as in a terminal of that width, and not cut."""
    client.processes = [process("a_process_with_quite_a_long_name", reason="because " * 12)]
    resources = [resource(name) for name in ("memory", "cpu", "disk")]
    client.hosts = [host("robot-with-a-long-name", resources=resources)]
    out = rosrm(*words.split(), columns="80").out
    assert 0 < max(map(len, out.splitlines())) <= 80
    assert ("…" in out) == ("top" in words)


def test_top_outlives_a_master_that_is_away_for_a_while(rosrm, client, while_asleep):
    while_asleep({"fails": NoMaster("gone")})
    result = rosrm("top", "--count", 2)
    assert (result.code, "the master does not answer" in result.out) == (0, True)


def test_top_shows_pictures_with_line_ends_and_takes_a_unit(rosrm, client, monkeypatch):
    """The prompt appears below the last picture."""
    slept = []
    monkeypatch.setattr("time.sleep", slept.append)
    result = rosrm("top", "--period", "1500ms", "-n", 2)
    assert (result.code, slept, len(client.asked)) == (0, [1.5], 2)
    assert "alpha" in result.out
    assert result.out.endswith("\n")


@pytest.mark.parametrize(
    ("option", "says"),
    [
        (["--period", "2 parsecs"], "--period: unknown unit 'parsecs'"),
        (["--period", "0"], "--period: '0' is not at least 0.1"),
        (["--sort", "mem"], "--sort: 'mem' is not one of state, cpu, memory, name"),
    ],
)
def test_top_refuses_what_it_does_not_know(rosrm, client, option, says):
    result = rosrm("top", *option)
    assert (result.code, says in result.err) == (2, True), result.err
    assert not client.asked


def test_explain_of_a_process_that_is_not_there_names_the_nearest(rosrm, client):
    client.fails = Refused("no such process: talkr", "unknown")
    client.list = FakeClient().list
    result = rosrm("explain", "talkr")
    assert (result.code, result.out) == (1, "")
    assert "no such process: 'talkr'; did you mean 'talker'?" in result.err
