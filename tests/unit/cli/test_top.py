"""Live table as a pure function of a snapshot of the cluster."""

from __future__ import annotations

import re
from io import StringIO

import pytest
from rich.console import Console
from rich.live import Live

from rosrm.cli.output import top, top_screen
from rosrm.model.rows import Listing
from tests.unit.core.cluster import Cluster
from tests.unit.core.cluster import process as core_process

from .conftest import HOSTS, NAN, PROCESSES, event, host, process, resource


def drawn(snapshot, width=80, **more):
    output = StringIO()
    Console(file=output, width=width, color_system=None).print(top.TopView(snapshot, **more))
    return output.getvalue()


def test_it_shows_hosts_processes_queue_and_newest_events():
    snapshot = Listing("lab", 65.0, 9, HOSTS, PROCESSES, events=[event(i) for i in range(9)])
    text = drawn(snapshot, events=3)
    assert text.startswith("lab  65 s   1 running   1 queued   1 failed   1 finished")
    for name in ("alpha", "beta", "gamma", "talker", "next", "crashed"):
        assert name in text
    assert text.count("talker goes to alpha") == 3


@pytest.mark.parametrize("width", [80, 120])
def test_it_keeps_to_the_width_of_the_terminal(width):
    many = [process(f"process_with_a_long_name_{i}", reason="x" * 90) for i in range(40)]
    wide = [host(f"h{i}", resources=[resource(n) for n in ("memory", "cpu", "disk", "gpu")])
            for i in range(4)]  # fmt: skip
    text = drawn(Listing("lab", 1.0, 1, wide, many, events=[event(1, message="y" * 200)]), width)
    assert max(len(line) for line in text.splitlines()) <= width
    assert "and 22 more" in text


def lines_of(*rows, hosts=HOSTS, width=80, **more):
    """Return the lines of a table of these processes."""
    return drawn(Listing("lab", 1.0, 1, hosts, list(rows)), width, **more).splitlines()


def test_a_title_is_broken_between_states():
    """At 80 columns a number stays beside its state."""
    states = ("running", "starting", "set_aside", "queued", "failed", "cancelled", "finished")
    rows = [process(f"{state}{i}", state) for state in states for i in range(4)]
    first, second, *_ = drawn(Listing("laboratory", 650.0, 1, HOSTS, rows)).splitlines()
    assert first.endswith("4 failed")
    assert second == "  4 cancelled   4 finished"


LONG = "no host may take it: shelf: it lacks the label camera=front; desk: it lacks it too; " * 3


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_long_reason_is_cut_and_names_stay_whole(width):
    """Each process has one line with its whole name and state, whatever its reason is."""
    names = ["camera_driver_front", "sleeper", "mapkeeper"]
    rows = [
        process("camera_driver_front", "set_aside", "", reason=LONG),
        process("sleeper", reason=LONG, restarts=3),
        process("mapkeeper", "migrating", reason=f"to shelf: {LONG}"),
    ]
    lines = lines_of(*rows, width=width)
    assert max(map(len, lines)) <= width
    for name, state in zip(names, ("set aside", "running", "migrating"), strict=True):
        (line,) = [line for line in lines if line.startswith(f"{name} ")]
        assert state in line
    (moving,) = [line for line in lines if line.startswith("mapkeeper ")]
    assert "to shelf: no host" in moving


def test_reasons_that_are_cut_show_where_they_differ():
    """A common beginning, or one that repeats the state, is cut first."""
    lacks = "no host may take it: shelf: it lacks the label"
    rows = [
        process("camera_driver_front", reason="restarted 3 times after exit code 1"),
        process("camera_driver_rear", "set_aside", "", reason=f"{lacks} camera=rear"),
        process("planner", "set_aside", "", reason=f"{lacks} gpu=true; desk: it lacks it too"),
        process("arm", "set_aside", "", reason="no host may take it: shelf: it has no gpu; " * 4),
    ]
    shown = {line.split()[0]: line for line in lines_of(*rows) if line}
    assert shown["camera_driver_front"].endswith(" restarted 3 times after exi…")
    assert shown["camera_driver_rear"].endswith(" …lacks the label camera=rear")
    assert shown["planner"].endswith(" …gpu=true; desk: it lacks i…")
    assert shown["arm"].endswith(" …has no gpu; no host may ta…")


def test_a_reason_gets_the_room_of_empty_columns():
    arm = process("arm", "set_aside", "", reason=f"no host may take it: {'x' * 40} label a=b")
    assert [line for line in lines_of(arm) if line.endswith(f" …{'x' * 40} label a=b")]


def test_the_master_begins_reasons_as_the_table_knows():
    cluster = Cluster("a")
    cluster.submit(core_process("p", required_labels={"gpu": "new"}))
    assert cluster["p"].reason.startswith(top._BEGINNINGS[cluster.phase("p")])


@pytest.mark.parametrize("width", [50, 60, 80, 120])
def test_bars_keep_their_numbers(width):
    """A bar becomes shorter before a resource is left out; its percentage is never cut."""
    resources = [resource(name) for name in ("memory", "cpu", "disk")]
    robots = [host(f"robot-{i}", resources=resources) for i in range(2)]
    lines = lines_of(hosts=robots, width=width)
    shown = len(next(line for line in lines if line.startswith("HOST")).split()) - 2
    assert shown >= (3 if width >= 60 else 2)
    assert [line.count(" 40%") for line in lines if line.startswith("robot-")] == [shown, shown]


def test_processes_have_a_head_cpu_and_a_reason():
    """The columns are those of `rosrm ps`; a moving process shows destination and reason."""
    lines = lines_of(process("a", migrations=2))
    (head,) = [line for line in lines if line.startswith("NAME")]
    assert head.split() == ["NAME", "STATE", "HOST", "SINCE", "CPU", "MEMORY", "WHY"]
    (line,) = [line for line in lines if line.startswith("a ")]
    assert "0.50" in line
    assert "moved 2x" in line


@pytest.mark.parametrize(
    ("sort", "order"),
    [
        ("state", ["idle", "busy", "big"]), ("cpu", ["busy", "idle", "big"]),
        ("memory", ["big", "idle", "busy"]), ("name", ["big", "busy", "idle"]),
    ],
)  # fmt: skip
def test_sorting(sort, order):
    """The default order is by state; by usage the greatest comes first."""
    rows = [
        process("idle", cpu=0.2, memory=200),
        process("busy", cpu=0.9, memory=100),
        process("big", cpu=0.1, memory=900),
    ]
    lines = lines_of(*rows, hosts=[], sort=sort)
    assert [line.split()[0] for line in lines if line.split()[1:2] == ["running"]] == order


def test_an_empty_cluster_is_a_picture_too():
    text = drawn(Listing("lab", 1.0, 0), note="the master does not answer")
    assert "no host yet" in text
    assert "no process" in text
    assert "the master does not answer" in text


@pytest.mark.parametrize(
    ("row", "picture"),
    [
        (resource("m", 0.5, 0.2, 0.8), "█████▒▒░│░  50%"),
        (resource("m", 0.0, 0.0, 1.0), "░░░░░░░░░│   0%"),
        (resource("m", 1.7, 0.0, 0.8), "████████│█ 170%"),
        (resource("m", NAN, NAN, 0.8), "░░░░░░░░│░   ?%"),
    ],
)
def test_a_bar_shows_used_promised_and_limit(row, picture):
    assert top.bar(row, 10).plain == picture


def test_what_matters_comes_first_and_the_queue_keeps_its_order():
    rows = [
        process("old", "finished", since=50.0),
        process("new", "finished", since=1.0),
        process("second", "queued", "", queue_position=2),
        process("first", "queued", "", queue_position=1),
        process("works"),
        process("lost", "stuck"),
    ]
    order = ["lost", "works", "first", "second", "new", "old"]
    names = [line.split(" ")[0] for line in lines_of(*rows, hosts=[])]
    assert [name for name in names if name in order] == order


class _Keys:
    """Keys that a user presses, one for each time that the view waits for one."""

    def __init__(self, *keys):
        self.keys = list(keys)

    def __call__(self, seconds):
        return self.keys.pop(0) if self.keys else ""


def _live(*keys):
    """Return a live view into text, and the text."""
    output = StringIO()
    console = Console(file=output, width=100, color_system=None, force_terminal=True)
    screen = Live(console=console, auto_refresh=False)
    snapshot = Listing("lab", 1.0, 0, HOSTS, PROCESSES)
    return top_screen._LiveView(screen, _Keys(*keys), snapshot, "state"), screen, output


def test_a_silent_master_is_shown_while_its_answer_is_awaited(monkeypatch):
    """After 1 s the view says for how long the master has not answered, until it answers."""
    view, screen, output = _live()
    seen = []

    def look(on_wait):
        for seconds in (0.5, 1.5):
            on_wait(seconds)
            seen.append(output.getvalue())
        return Listing("lab", 2.0, 0, HOSTS, PROCESSES)

    with screen:
        view.draw()
        view.look_again(look)
        before = len(output.getvalue())
        view.draw()
    assert "has not answered" not in seen[0]
    assert re.search(r"the master has not answered for \d+\.\d s", seen[1])
    assert "has not answered" not in output.getvalue()[before:]


def test_q_ends_top_while_the_master_is_silent():
    """The key is read while the answer is awaited."""
    view, screen, _ = _live("", "q")

    def look(on_wait):
        for seconds in (0.1, 0.2, 0.3):
            on_wait(seconds)
        raise AssertionError("q was not read")

    with screen, pytest.raises(top_screen._Quit):
        view.look_again(look)
