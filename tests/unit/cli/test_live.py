"""The live table is a pure function of a snapshot."""

from __future__ import annotations

from io import StringIO

import pytest
from rich.console import Console

from rosrm.cli import live
from rosrm.core.views import Snapshot

from .conftest import HOSTS, NAN, PROCESSES, event, host, process, resource


def drawn(snapshot, width=80, **more):
    output = StringIO()
    Console(file=output, width=width, color_system=None).print(live.render(snapshot, **more))
    return output.getvalue()


def test_it_shows_hosts_processes_queue_and_newest_events():
    snapshot = Snapshot("lab", 65.0, 9, HOSTS, PROCESSES, events=[event(i) for i in range(9)])
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
    text = drawn(Snapshot("lab", 1.0, 1, wide, many, events=[event(1, message="y" * 200)]), width)
    assert max(len(line) for line in text.splitlines()) <= width
    assert "and 22 more" in text


def test_an_empty_cluster_is_a_picture_too():
    text = drawn(Snapshot("lab", 1.0, 0), note="the master does not answer")
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
    assert live.bar(row, 10).plain == picture


def test_what_matters_comes_first_and_the_queue_keeps_its_order():
    rows = [
        process("old", "finished", since=50.0),
        process("new", "finished", since=1.0),
        process("second", "queued", "", queue_position=2),
        process("first", "queued", "", queue_position=1),
        process("works"),
        process("lost", "stuck"),
    ]
    text = drawn(Snapshot("lab", 1.0, 0, [], rows))
    order = ["lost", "works", "first", "second", "new", "old"]
    places = [text.index(f"\n{name} ") for name in order]
    assert places == sorted(places)
