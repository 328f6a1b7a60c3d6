"""A slave that runs as root takes images of other hosts only where its own file says so."""

from __future__ import annotations

import os

import pytest

from rosrm.errors import CriuError
from rosrm_criu.executors import move
from rosrm_criu.options import CriuOptions
from rosrm_criu.strategy import Criu
from tests.criu_kit import HOST_FACTS

ALLOWED = {"as_root": True}


def here(options):
    return {"host": "robot-2", "options": options}


@pytest.mark.parametrize(
    ("user", "options", "takes"),
    [
        (0, {}, False), (0, {"as_root": False}, False), (0, {"as_root": "yes"}, False),
        (0, ALLOWED, True), (1000, {}, True), (1000, ALLOWED, True),
    ],
)  # fmt: skip
def test_root_takes_no_image_unless_its_file_says_so(monkeypatch, user, options, takes):
    """The refusal says what to write, and is the reason that `rosrm explain` shows."""
    monkeypatch.setattr(os, "geteuid", lambda: user)
    refusal = move.refusal_of_images(here(options))
    assert (refusal == "") == takes
    assert takes or "write `strategies: {criu: {as_root: true}}` in its host file" in refusal
    facts = {**HOST_FACTS, "no_transfer": ""}
    source = {**facts, "host": "robot-1", "takes_none": "it takes none"}
    fault = Criu(CriuOptions()).host_fault(
        source, {**facts, "host": "robot-2", "takes_none": refusal}
    )
    assert fault == refusal


def test_an_image_stays_possible_on_the_host_of_its_process():
    """A checkpoint is restored where it was made."""
    facts = {**HOST_FACTS, "no_transfer": "", "host": "robot-1", "takes_none": "it takes none"}
    assert Criu(CriuOptions()).host_fault(facts, facts) == ""


def test_the_slave_itself_refuses_to_fetch(monkeypatch, tmp_path):
    """A master that asks for it all the same opens no receiver."""
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    arguments = {
        "process": "p", "source": 1, "destination": 2, "attempt": "p#1-2", "timeout": 5.0,
        "keep": 5.0,
        "here": {**here({}), "state": str(tmp_path), "pids": {}, "instances": []},
    }  # fmt: skip
    with pytest.raises(CriuError, match="robot-2 runs as root"):
        move.introduce(arguments)
