"""Plans in the journal: every field of every step, and refusal of unknown content."""

from __future__ import annotations

import json
import re
import threading
from typing import Any

import pytest

from rosrm.core.master.applications.planning import copied
from rosrm.model.codec import from_plain, to_plain
from rosrm.model.plan import (
    AwaitReady,
    AwaitReleased,
    Commit,
    Configure,
    Execute,
    HandoffPhase,
    Plan,
    SetLifecycle,
    SetRestart,
    Start,
    Stop,
)
from rosrm.model.values import InstanceId, RestartPolicy
from tests.unit.core.cluster import Cluster

ONE, MISSING = InstanceId("p", 1), object()
EVERYTHING = Plan(
    (
        Start(
            ONE, "a", 1.5, "alias", undo=Stop(ONE, "a", 2.0), shadow=True, remappings={"~/a": "/b"}
        ),
        AwaitReady(ONE, "a", 3.0, undo=Execute("x", "a", {}, 1.0, undo=Commit())),
        Configure(HandoffPhase.SHADOW, 4.0, awaited=False),
        SetRestart(ONE, "a", RestartPolicy("always", delay=0.1, attempts=7), 5.0),
        Execute("dump", "b", {"to": ["x", {"deep": 1}], "n": None}, 6.0),
        Commit(image="drop"),
        AwaitReleased(ONE, "a", 2.5),
        Start(ONE, "b", 1.0, inactive=True),
        SetLifecycle(ONE, "a", "inactive", 3.5, undo=SetLifecycle(ONE, "a", "active", 3.5)),
    ),
    overlap=7.5,
    options={"why": "not"},
)


def stored() -> Any:
    return json.loads(json.dumps(to_plain(EVERYTHING), default=dict))


def test_a_plan_survives_the_journal() -> None:
    """Each field is restored."""
    assert from_plain(Plan, stored()) == EVERYTHING


@pytest.mark.parametrize(
    ("path", "value", "fault"),
    [
        (("strange",), 1, "unknown strange; allowed: steps, "),
        (("overlap",), "long", "overlap: float is required, not 'long'"),
        (("steps", 0, "kind"), "teleport", "steps[0].kind 'teleport'; allowed: start, "),
        (("steps", 0, "shadow"), "yes", "steps[0].shadow: bool is required, not 'yes'"),
        (("steps", 0, "colour"), 1, "steps[0]: unknown colour; allowed: instance, "),
        (("steps", 0, "host"), MISSING, "steps[0]: host is missing"),
        (("steps", 0, "undo", "timeout"), None, "steps[0].undo.timeout: float is required"),
        (("steps", 0, "instance", "number"), "1", "steps[0].instance.number: int is required"),
        (("steps", 2, "phase"), "JUMP", "steps[2].phase 'JUMP'; allowed: SHADOW, "),
        (("steps", 3, "restart", "colour"), 1, "steps[3].restart: unknown colour"),
        (("steps", 8, "state"), "finalized", "steps[8].state"),
        (("steps", 4, "arguments"), [], "steps[4].arguments: a mapping is required, not []"),
    ],
)
def test_a_plan_with_unknown_content_is_refused(path: Any, value: Any, fault: str) -> None:
    """An unknown plan is refused as a whole, rather than carried out in part."""
    plain = stored()
    inner = plain
    for key in path[:-1]:
        inner = inner[key]
    if value is MISSING:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    with pytest.raises(ValueError, match=re.escape(fault)):
        from_plain(Plan, plain)


def test_a_plan_copies_no_plugin() -> None:
    """A policy with a lock cannot be copied, and a copy of one would be called beside the guard."""

    class Guarded:
        def __init__(self) -> None:
            self._lock = threading.Lock()

    cluster = Cluster("a")
    cluster.state.replication.policy = Guarded()  # type: ignore[assignment]
    assert copied(cluster.state).replication.policy is cluster.state.replication.policy
