"""Processes as a tree of applications, namespaces and arrays."""

from hypothesis import given
from hypothesis import strategies as st

from rosrm_web.page.tree import Choice, Folding, is_group, tree_rows
from tests.unit.tools.web.test_page_rows import process

PROCESSES = (
    process("camera"),
    process("left.camera", application="nav", cpu=0.5, host="a"),
    process("left.lidar", "failed", application="nav", cpu=1.0, host="b", reason="exit code 4"),
    process("planner", application="nav", restarts=2),
    process("render-1", "set_aside", array="render", application="nav", host=""),
)
OPEN, CLOSED = Folding(default=True), Folding(default=False)


def test_a_process_is_below_its_application_and_its_namespace_or_array():
    """The level counts the groups above; a process without any is at the top."""
    found = {key: (row["level"], row["parent"]) for key, row in tree_rows(PROCESSES, OPEN).items()}

    assert found == {
        "camera": (1, ""),
        "nav/": (1, ""),
        "planner": (2, "nav/"),
        "nav//left/": (2, "nav/"),
        "left.camera": (3, "nav//left/"),
        "left.lidar": (3, "nav//left/"),
        "nav/array render/": (2, "nav/"),
        "render-1": (3, "nav/array render/"),
    }


def test_the_row_of_a_group_sums_its_processes():
    """The row has the style of the gravest state, also while the group is closed."""
    row = tree_rows(PROCESSES, CLOSED)["nav/"]

    assert row["state"] == "2 running, 1 failed, 1 set aside"
    assert (row["cpu"], row["memory"], row["restarts"]) == ("2.00", "8.0 MB", 2)
    assert (row["host"], row["style"], row["open"]) == ("3 hosts", "bad", False)


@given(st.sets(st.sampled_from(["nav/", "nav//left/", "nav/array render/"])), st.booleans())
def test_all_that_is_shown_is_below_open_groups(touched, default):
    """No row is shown without its parent, and nothing below a closed group."""
    folding = Folding(default, dict.fromkeys(touched, not default))

    rows = tree_rows(PROCESSES, folding)

    for row in rows.values():
        assert not row["parent"] or rows[row["parent"]]["open"]
    for group in filter(is_group, rows):
        has_members = any(row["parent"] == group for row in rows.values())
        assert has_members == rows[group]["open"] == folding.is_open(group)


def test_a_search_finds_name_application_host_state_and_reason():
    """Upper and lower case are equal, and only processes in the chosen state are found."""

    def found(**choice: str) -> list[str]:
        return [row.name for row in PROCESSES if Choice(**choice).admits(row)]

    assert found(text="LIDAR") == found(text="exit") == found(state="failed") == ["left.lidar"]
    assert found(text="set aside") == ["render-1"]
    assert len(found(text="nav")) == 4
    assert found(state="running", text="exit") == []


def test_all_groups_open_and_close_at_once():
    """Groups that the user has opened or closed before follow, too."""
    folding = Folding(default=True, touched={"nav/": False})

    folding.set_all(is_open=True)
    assert "planner" in tree_rows(PROCESSES, folding)
    folding.set_all(is_open=False)
    assert set(tree_rows(PROCESSES, folding)) == {"camera", "nav/"}
