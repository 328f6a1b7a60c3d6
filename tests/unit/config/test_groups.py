"""The section `group` of a work file, and the gangs of its processes."""

from __future__ import annotations

import pytest

from rosrm.config.work import load_work, processes_of
from rosrm.model.values import GroupMembership

WORK = """
    group: {group}
    processes:
      - {{name: rviz, command: x}}
      - {{name: "worker_{{i}}", foreach: {{i: "range(0, 2)"}}, command: x}}
"""


@pytest.mark.parametrize(
    ("group", "ends"),
    [
        ("{name: demo, ends_with: rviz}", ["always", "never", "never"]),
        ("{name: demo, ends_with: [rviz, worker_1]}", ["always", "never", "always"]),
        ("{name: demo, ends_with: rviz, fails_with: any}", ["always", "on-failure", "on-failure"]),
        ("{name: demo, fails_with: worker_0}", ["never", "on-failure", "never"]),
        ("{name: demo, ends_with: any, fails_with: rviz}", ["always"] * 3),
    ],
)
def test_all_processes_of_a_file_are_members_of_its_group(file, group, ends):
    """Each one carries which of its ends ends the group."""
    specs = load_work(file(WORK.format(group=group)))
    assert [spec.group for spec in specs] == [GroupMembership("demo", one) for one in ends]


@pytest.mark.parametrize(
    ("group", "said"),
    [
        (
            "{name: demo, ends_with: rvz}",
            "group.ends_with: no process 'rvz' in this file; did you mean 'rviz'?",
        ),
        (
            "{name: demo, fails_with: [rviz, x]}",
            "group.fails_with: no process 'x' in this file; there are: rviz, worker_0, worker_1",
        ),
        ("{ends_with: rviz}", "group.name is missing"),
        ("{name: demo}", "group: give `ends_with` or `fails_with`"),
        ("{name: ../x, ends_with: any}", "'../x' cannot be the name of a group"),
        ("{name: demo, end_with: any}", "unknown key 'end_with' in group; did you mean"),
        ("demo", 'group: a mapping is required, not "demo"'),
    ],
)
def test_a_wrong_group_is_refused_with_its_place(refusal, group, said):
    assert said in refusal(load_work, WORK.format(group=group))


def test_a_process_of_a_python_program_has_a_group_only_with_its_file():
    """One mapping without `processes` is one process."""
    (spec,) = processes_of({"name": "a", "command": "x"})
    assert spec.group == GroupMembership()


def test_a_gang_may_be_named_in_the_defaults_of_the_file(file):
    """An empty name takes a process out of it."""
    text = """
        defaults: {together: sensing}
        processes:
          - {name: a, command: x}
          - {name: b, command: x, together: 3}
          - {name: c, command: x, together: ""}
    """
    assert [spec.together for spec in load_work(file(text))] == ["sensing", "3", ""]


def test_a_wrong_name_of_a_gang_is_refused_with_its_place(refusal):
    said = refusal(load_work, "processes: [{name: a, command: x, together: a/b}]")
    assert "f.yaml:1:45: together: 'a/b' cannot be the name of a gang" in said
