"""Evaluation of the paper's claims: evidence for and against them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.paper.judging import (
    NOISE,
    line,
    not_to_emptiest,
    over,
    proportion,
    room_left,
    widest_gap,
    wrong_move,
)
from benchmarks.paper.trace import Happening, HostLook, Look, Move, Trace

CAPACITY = 1e9
BASE = 0.1


def look_at(elapsed, usages, states=None, accepting=True):
    hosts = {name: HostLook(usage, 0.0, CAPACITY, accepting) for name, usage in usages.items()}
    return Look(elapsed, hosts, states or {})


def filled(sizes, choose):
    """Return a run in which `choose` places processes of some bytes by the hosts' usages."""
    usages = dict.fromkeys(("host1", "host2", "host3"), BASE)
    trace = Trace(looks=[look_at(0.0, usages)])
    for number, size in enumerate(sizes):
        host = choose(usages)
        trace.events.append(
            Happening(number + 1, number + 0.5, 0.0, "assigned", f"process_{number}", host)
        )
        usages[host] += size / CAPACITY
        trace.looks.append(look_at(number + 1.0, usages))
    return trace


def emptiest(usages):
    return min(usages, key=usages.get)


def fullest(usages):
    return max(usages, key=usages.get)


def needs_of(sizes):
    return {f"process_{number}": float(size) for number, size in enumerate(sizes)}


sizes = st.lists(st.integers(8_000_000, 80_000_000), min_size=1, max_size=30)


@given(sizes)
def test_placing_on_the_emptiest_is_found_right_and_balanced(chosen):
    """The bound of Fig. 6: hosts never differ by more than the largest process."""
    trace = filled(chosen, emptiest)
    assert not_to_emptiest(trace, needs_of(chosen)) == []
    assert widest_gap(trace, trace.hosts) <= max(chosen) / CAPACITY + 1e-9


@given(sizes.filter(lambda chosen: len(chosen) > 1 and chosen[0] / CAPACITY > 2 * NOISE))
def test_placing_on_the_fullest_is_found_wrong(chosen):
    """With all on one host, each process but the first is named."""
    wrong = not_to_emptiest(filled(chosen, fullest), needs_of(chosen))
    assert len(wrong) == len(chosen) - 1


def test_an_assignment_that_is_given_again_counts_once():
    """A second assignment of a process moves its memory, and does not double it."""
    usages = {"host1": BASE, "host2": BASE}
    trace = Trace(looks=[look_at(0.0, usages)])
    trace.events = [
        Happening(1, 1.0, 0.0, "assigned", "a", "host1"),
        Happening(2, 6.0, 0.0, "assigned", "a", "host1"),
        Happening(3, 7.0, 0.0, "assigned", "b", "host2"),
    ]
    assert not_to_emptiest(trace, {"a": 1e8, "b": 1e8}) == []
    assert [(event.process, event.elapsed) for event in trace.placed()] == [("a", 6.0), ("b", 7.0)]
    assert trace.curves()["given_again"] == 1


def test_a_host_that_joins_is_judged_from_when_it_is_seen():
    """A process placed earlier could not have gone to that host."""
    trace = Trace(looks=[look_at(0.0, {"host1": 0.5})])
    trace.looks.append(look_at(2.0, {"host1": 0.5, "host2": BASE}))
    trace.events = [
        Happening(1, 1.0, 0.0, "assigned", "a", "host1"),
        Happening(2, 3.0, 0.0, "assigned", "b", "host1"),
    ]
    (wrong,) = not_to_emptiest(trace, {"a": 1e6, "b": 1e6})
    assert wrong.startswith("b went to host1 at 50.1 % while host2 was at 10.0 %")


@given(
    st.floats(-1e3, 1e3), st.floats(-1e3, 1e3),
    st.lists(st.integers(0, 10_000), min_size=2, max_size=20, unique=True),
)  # fmt: skip
def test_points_on_a_line_give_the_line(slope, intercept, x):
    """The line explains all of the variance, unless there is none."""
    fit = line(x, [slope * one + intercept for one in x])
    assert fit.slope == pytest.approx(slope, abs=1e-6, rel=1e-6)
    assert fit.intercept == pytest.approx(intercept, abs=1e-3, rel=1e-6)
    if abs(slope) > 1e-3:
        assert fit.r2 > 0.999


def test_scattered_points_do_not_pass_for_a_line():
    """A host that holds half as many is below the bound of Fig. 8."""
    assert line(range(1, 11), [8, 16, 24, 32, 40, 48, 56, 64, 72, 76]).r2 < 0.999
    assert line(range(1, 11), [8 * n for n in range(1, 11)]).r2 == 1.0


@given(st.floats(0.1, 1e3), st.lists(st.integers(1, 100), min_size=2, max_size=20, unique=True))
def test_a_proportion_goes_through_the_origin(slope, x):
    """Points in proportion are all explained, points beside it are not."""
    fit = proportion(x, [slope * one for one in x])
    assert (fit.slope, fit.intercept) == (pytest.approx(slope), 0.0)
    assert fit.r2 > 0.999
    assert proportion(x, [slope * one + 10 * slope * max(x) for one in x]).r2 < 0.999


def test_one_point_is_no_line():
    """The error has the given points."""
    with pytest.raises(ValueError, match="two points"):
        line([3, 3], [1, 2])


def test_room_counts_what_is_in_flight():
    """A host with room by its reading alone has none."""
    host = HostLook(0.5, 0.25, CAPACITY, accepting=True)
    look = Look(0.0, {"host1": host, "host2": HostLook(0.5, 0.0, CAPACITY, accepting=True)}, {})
    assert room_left(look, 0.1 * CAPACITY, 0.8) == ["host2"]


def test_who_passed_the_limit_is_named_with_the_peak():
    """Within the noise, no host counts as over the limit."""
    trace = Trace(looks=[look_at(t, {"host1": u, "host2": 0.8}) for t, u in enumerate((0.7, 0.85))])
    assert over(trace, 0.8) == {"host1": 0.85}


# --- migrations -----------------------------------------------------------------------------------

MOVE = Move("p", "host1", "host2", 1.0, 1.5, size=0.3 * CAPACITY)


@pytest.mark.parametrize(
    ("usages", "word"),
    [
        ({"host1": 0.81, "host2": 0.2, "host3": 0.3}, ""),
        ({"host1": 0.5, "host2": 0.2, "host3": 0.3}, "not at its limit"),
        ({"host1": 0.81, "host2": 0.6, "host3": 0.3}, "had no room"),
        ({"host1": 0.81, "host2": 0.4, "host3": 0.2}, "host3 had the larger margin"),
    ],
)
def test_a_move_is_judged_by_what_was_seen_right_before(usages, word):
    """The source is at its limit, and the destination is the emptiest host with room."""
    wrong = wrong_move(look_at(0.9, usages), MOVE, MOVE.size, limit=0.8, headroom=0.05)
    assert wrong == "" if not word else word in wrong


def test_an_emptier_host_without_room_is_no_reproach():
    """The largest margin counts among hosts where the process fits."""
    look = look_at(0.9, {"host1": 0.81, "host2": 0.4})
    small = HostLook(0.1, 0.0, 0.2 * CAPACITY, accepting=True)
    look = Look(look.elapsed, {**look.hosts, "host3": small}, {})
    assert wrong_move(look, MOVE, MOVE.size, limit=0.8, headroom=0.05) == ""


def test_moves_are_read_from_the_record():
    """Begin and end of a move belong together; the size is the last one seen before."""
    facts = {"from": "host1", "to": "host2"}
    trace = Trace(
        looks=[Look(0.9, {}, {}, {"p": 7.0}), Look(1.2, {}, {}, {"p": 9.0})],
        events=[
            Happening(1, 1.0, 0.0, "migration_begun", "p", "host2", facts=facts),
            Happening(2, 1.5, 0.0, "migrated", "p", "host2", facts=facts),
        ],
    )
    assert trace.moves() == [Move("p", "host1", "host2", 1.0, 1.5, 7.0)]
