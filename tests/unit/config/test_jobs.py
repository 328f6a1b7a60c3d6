"""Arrays, retries and schedules of jobs in `work.yaml`."""

from __future__ import annotations

import pytest

from rosrm.config.work import load_work
from rosrm.model.arrays import NO_ARRAY, ArrayMembership
from rosrm.model.durations import LONGEST
from rosrm.model.schedules import NO_SCHEDULE, Schedule
from rosrm.model.values import RestartPolicy


def specs(file, entry):
    """Return the specs of one entry; it is a job with a command."""
    return load_work(file(f"processes: [{{kind: job, command: x, {entry}}}]"))


@pytest.mark.parametrize(
    ("array", "indexes"),
    [
        ("1-3", [1, 2, 3]), ("0-0", [0]), ("1-10:4", [1, 5, 9]), (" 8 - 9 ", [8, 9]),
        ("[1, 4, 9]", [1, 4, 9]),
    ],
)  # fmt: skip
def test_an_array_makes_one_job_for_each_index(file, array, indexes):
    """Each has the array's name, its index, and the bound."""
    found = specs(file, f"name: r, array: {array}, parallel: 2")
    assert [spec.name for spec in found] == [f"r-{index}" for index in indexes]
    assert [spec.array for spec in found] == [ArrayMembership("r", one, 2) for one in indexes]


def test_the_index_is_put_into_all_texts(file):
    """A text that is the index alone becomes a number; a format is Python's."""
    entry = "arguments: [-n, '{array.index:03d}', '{{x}}'], environment: {I: '{array.index}'}"
    (spec,) = specs(file, f"name: r, array: [7], {entry}")
    assert spec.arguments == ("-n", "007", "{x}")
    assert spec.environment == {"I": "7"}
    text = "{name: 'r_{array.index}', kind: job, module: m, ros: true, array: [7], PARAMETERS}"
    parameters = "parameters: {i: '{array.index}'}"
    (node,) = load_work(file(f"processes: [{text.replace('PARAMETERS', parameters)}]"))
    assert (node.name, node.array.name, node.parameters) == ("r_7", "r", {"i": 7})


def test_an_array_beside_foreach_makes_an_array_for_each_row(file):
    """Each row has an array with its own name."""
    found = specs(file, "name: 'r_{q}', foreach: {q: [lo, hi]}, array: 1-2")
    assert [spec.name for spec in found] == ["r_lo-1", "r_lo-2", "r_hi-1", "r_hi-2"]
    assert [spec.array.name for spec in found] == ["r_lo", "r_lo", "r_hi", "r_hi"]


def test_the_jobs_of_an_array_may_spread_over_hosts(file):
    """The array is their group."""
    found = specs(file, "name: r, array: 1-2, spread: ''")
    assert {spec.neighbours[0].group for spec in found} == {"r"}


def test_retries_are_restarts_that_count_for_the_whole_run(file):
    """However long the job runs before it fails."""
    (spec,) = specs(file, "name: r, retries: 2")
    assert spec.restart == RestartPolicy("on-failure", attempts=2, window=LONGEST)
    assert {"restart.when", "restart.attempts", "restart.window"} <= set(spec.given)


def test_retries_of_a_process_replace_the_restart_policy_of_the_defaults(file):
    """And a restart policy of a process replaces `retries` of the defaults."""
    text = """
        defaults: {kind: job, command: x, DEFAULT}
        processes: [{name: r, OWN}]
        """
    wanted = RestartPolicy("on-failure", attempts=2, window=LONGEST)
    for default, own, policy in (
        ("restart: {delay: 3s}", "retries: 2", wanted),
        ("retries: 2", "restart: always", RestartPolicy("always")),
    ):
        (spec,) = load_work(file(text.replace("DEFAULT", default).replace("OWN", own)))
        assert spec.restart == policy


@pytest.mark.parametrize(
    ("entry", "schedule"),
    [
        ("every: 10min", Schedule(every=600.0)),
        ("at: '02:00'", Schedule(at=("02:00",))),
        ("at: 12:30", Schedule(at=("12:30",))),
        ("at: [2:00 UTC, 14:00 Europe/Berlin]", Schedule(at=("2:00 UTC", "14:00 Europe/Berlin"))),
        ("at: 02:00, on: [mon, fri]", Schedule(at=("02:00",), on=("mon", "fri"))),
        ("at: 02:00, on: sun", Schedule(at=("02:00",), on=("sun",))),
        ("priority: 1", NO_SCHEDULE),
    ],
)
def test_a_schedule_is_an_interval_or_times_of_day(file, entry, schedule):
    """Times keep their text until the master has accepted the job."""
    (spec,) = specs(file, f"name: p, {entry}")
    assert (spec.schedule, spec.array) == (schedule, NO_ARRAY)


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("array: 1-2", "array: only a job has it, and this process is a service; set `kind: job`"),
        ("every: 2s", "every: only a job has it"),
        ("at: 02:00", "at: only a job has it"),
        ("retries: 2", "retries: only a job has it, and this process is a service"),
        ("kind: job, array: 3-1", "array: 3-1: the first index is above the last one; write 1-3"),
        ("kind: job, array: 1-9:0", "array: 1-9:0: a step of 0"),
        ("kind: job, array: 0-10000", "array: makes 10001 processes; at most 10000 are allowed"),
        ("kind: job, array: 1-999999999999999999", "array: makes 999999999999999999 processes"),
        ("kind: job, array: [1, 2, 1]", "array: the index 1 is given 2 times"),
        ("kind: job, array: [2147483648]", "the index 2147483648 is not within 0..2147483647"),
        ("kind: job, array: [-1]", "the index -1 is not within"),
        ("kind: job, array: [a]", "a list of whole numbers is required; 'a' is none"),
        ("kind: job, array: []", "array: no index; a range such as 1-100"),
        ("kind: job, array: 5", "array: a range such as 1-100, or 1-100:10 in steps, or a list"),
        ("kind: job, array: {name: x, index: 1}", "array: a range such as 1-100"),
        ("kind: job, array: 1-9, foreach: {i: range(2000)}", "makes more than 10000 processes"),
        ("kind: job, array: 1-2, parallel: 0", "parallel: "),
        ("kind: job, arguments: '{array.index}'", "arguments: {array.index} needs `array` in the"),
        ("kind: job, foreach: {i: [1]}, arguments: '{array.index}'", "needs `array` in the"),
        ("kind: job, parallel: 2", "parallel: only an array has a number of jobs at a time"),
        ("kind: job, every: 10s, at: 02:00", "every: an interval and times of day (`at`) exclude"),
        ("kind: job, every: 0.9s", "every: '0.9s' is not at least 1"),
        ("kind: job, at: 24:00", "at: '24:00' is no time of day; for example \"02:00\" or"),
        ("kind: job, at: 02:00 Europe/Berln", "time zone 'Europe/Berln'; did you mean Europe/Berl"),
        ("kind: job, at: 02:00 ../../etc/passwd", "unknown time zone"),
        ("kind: job, on: mon", "on: only times of day (`at`) have days"),
        ("kind: job, at: 02:00, on: monday", "on: 'monday' is no day; allowed: mon, tue, wed"),
        ("kind: job, retries: 2, restart: always", "retries is a short form of `restart: {when:"),
    ],
)
def test_what_makes_no_sense_is_refused(refusal, entry, said):
    """The error names the key and what is allowed."""
    assert said in refusal(load_work, f"processes: [{{name: p, command: x, {entry}}}]")


def test_the_job_of_an_array_that_is_a_node_has_the_index_in_its_name(refusal):
    """A ROS node has no `-` in its name, so the error shows another form."""
    entry = "name: r, kind: job, module: m, ros: true, array: 1-2"
    said = refusal(load_work, f"processes: [{{{entry}}}]")
    assert "write {array.index} into the name: r_{array.index}" in said


@pytest.mark.parametrize("key", ["array: 1-2", "parallel: 2"])
def test_an_array_is_no_default(refusal, key):
    """Each entry has its own."""
    said = refusal(load_work, f"{{defaults: {{{key}}}, processes: [{{name: p, command: x}}]}}")
    assert f"{key.partition(':')[0]} is allowed in a process only" in said
