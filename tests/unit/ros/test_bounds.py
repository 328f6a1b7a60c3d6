"""Bounds of messages: stated in the interfaces, checked where a message arrives."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rosrm.errors import Refused
from rosrm.ros import bounds
from rosrm.ros.bounds import LARGEST_MESSAGE, MOST_ENTRIES, MOST_LETTERS, bounds_of, check_bounds
from rosrm_msgs import msg, srv

INTERFACES = Path(__file__).parents[3] / "rosrm_msgs"
FIELD = re.compile(r"^[A-Za-z0-9]+(?P<many>\[\])? +(?P<name>[a-z_]+) *#.*at most (?P<most>\d+) ")


def stated() -> dict[str, int]:
    """Return the bounds in the comments of all interfaces, by message and field."""
    found = {}
    for file in [*INTERFACES.glob("msg/*.msg"), *INTERFACES.glob("srv/*.srv")]:
        parts = file.read_text().split("\n---\n")
        kinds = (
            [file.stem] if len(parts) == 1 else [f"{file.stem}_Request", f"{file.stem}_Response"]
        )
        for kind, part in zip(kinds, parts, strict=True):
            for match in filter(None, map(FIELD.match, part.splitlines())):
                found[f"{kind}.{match['name']}"] = int(match["most"])
    return found


def test_the_interfaces_state_every_bound_that_differs_from_the_general_one() -> None:
    """A client in another language knows the bounds from the interfaces."""
    assert stated() == {**bounds._OTHER_LETTERS, **bounds._OTHER_ENTRIES}


def test_the_fields_with_a_bound_exist() -> None:
    for stated_field in stated():
        kind, field = stated_field.split(".")
        package = srv if kind.endswith(("_Request", "_Response")) else msg
        assert field in {bound.field for bound in bounds_of(getattr(package, kind))}


def test_texts_and_sequences_without_a_bound_of_their_own_have_the_general_one() -> None:
    by_field = {bound.field: bound for bound in bounds_of(msg.MasterBeat)}
    assert by_field["name"] == ("name", "_name", 0, MOST_LETTERS, False)
    assert by_field["silent_hosts"] == ("silent_hosts", "_silent_hosts", MOST_ENTRIES, 0, False)


def many(kind, count: int):
    return count * [kind()]


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (msg.MasterBeat(name=65_537 * "n"), "MasterBeat.name has 65537 characters; at most 65536"),
        (msg.MasterBeat(silent_hosts=65_537 * [1]), "MasterBeat.silent_hosts has 65537 entries"),
        (
            srv.Submit.Request(envelope=msg.Envelope(request_id=65_537 * "x")),
            "Envelope.request_id has 65537 characters",
        ),
        (
            srv.Submit.Request(processes=many(msg.ProcessSpec, 10_001)),
            "Submit_Request.processes has 10001 entries; at most 10000",
        ),
        (
            srv.Submit.Request(processes=[msg.ProcessSpec(command=[131_073 * "x"])]),
            "ProcessSpec.command has 131073 characters; at most 131072",
        ),
        (srv.Cancel.Request(processes=[65_537 * "x"]), "Cancel_Request.processes has 65537"),
        (
            srv.RegisterHost.Request(
                host=msg.HostDescription(resources=many(msg.ResourceDescription, 17))
            ),
            "HostDescription.resources has 17 entries; at most 16",
        ),
        (
            srv.Cancel.Request(processes=1025 * [65_535 * "x"]),
            f"a Cancel_Request of 67174400 characters; at most {LARGEST_MESSAGE}",
        ),
    ],
)  # fmt: skip
def test_what_exceeds_a_bound_is_refused(message, said: str) -> None:
    """The reason names the field, also of a message in another one."""
    with pytest.raises(Refused, match=re.escape(said)):
        check_bounds(message)


def test_messages_within_their_bounds_are_counted() -> None:
    spec = msg.ProcessSpec(name="p", command=["a", "bc"])
    assert check_bounds(spec) == 1 + 2 + 3
    assert check_bounds(msg.ResourceInfo()) == 0


def test_messages_of_users_are_not_bounded() -> None:
    """The health watch of a slave subscribes to topics of users."""
    assert check_bounds("no message") == 0
