"""Cells and sentences on planned changes of applications."""

from rosrm.model.applications import Action, ApplicationRow, PlannedAction
from rosrm.model.modes import ModeRow
from rosrm_web.page.plan_rows import application_rows, interruptions, mode_rows, summary

PLAN = (
    PlannedAction("planner", Action.START, host="a"),
    PlannedAction("mapper", Action.STOP, before="a"),
    PlannedAction("camera", Action.START, host="b"),
    PlannedAction("lidar", Action.REPLACE, host="b", before="b"),
    PlannedAction("radar", Action.REPLACE, host="b", before="a"),
    PlannedAction("waiting", Action.STOP),
)


def test_the_summary_counts_the_actions():
    """The actions are in a fixed order, because the summary is the text of a button."""
    assert summary(PLAN) == "start 2, stop 2, replace 2"
    assert summary(()) == ""


def test_running_processes_that_stop_are_named():
    """A process that does not run is not interrupted, nor by a start or a move."""
    assert interruptions(PLAN) == "mapper is stopped; lidar and radar are replaced."
    assert interruptions((PLAN[0], PlannedAction("slam", Action.MOVE, "", "a", "b"))) == ""


def test_applications_and_modes_have_the_cells_of_the_command_line():
    """A degraded application is marked."""
    nav = ApplicationRow("nav", "user:ada", "degraded", 3, 2, 1, reason="planner has failed")
    rows = application_rows([nav])
    assert rows["nav"] == {
        "id": "nav", "name": "nav", "state": "degraded", "style": "bad", "version": "3",
        "running": "1/2", "why": "planner has failed",
    }  # fmt: skip
    modes = mode_rows([ModeRow("patrol", "in force", ("nav", "arm"), limits={"cpu": 0.5})])
    assert modes["patrol"]["applications"] == "nav, arm"
    assert modes["patrol"]["settings"] == "limits cpu 0.5"
