"""`rosrm criu check`: text output, JSON and exit code."""

from __future__ import annotations

import json

import pytest

from rosrm.errors import CriuError
from rosrm_criu.engine.binary import CriuBinary
from rosrm_criu.engine.probe import CriuSupport
from tests.criu_kit import HOST_FACTS


@pytest.fixture
def here(monkeypatch):
    """Replace the result of the check on this host."""

    def pretend(reason="", version="4.2.1", missing=""):
        def find(prefix):
            if missing:
                raise CriuError(missing)
            return CriuBinary((f"{prefix}/bin/criu",), version)

        able = CriuSupport(not reason, reason, {**HOST_FACTS, "version": version})
        monkeypatch.setattr("rosrm_criu.engine.binary.find", find)
        monkeypatch.setattr("rosrm_criu.engine.probe.probe", lambda criu: able)

    return pretend


def test_a_working_criu_is_reported_line_by_line(rosrm, here):
    here()
    result = rosrm("criu", "check", "--prefix", "/opt/criu")
    assert result.code == 0
    python = "Python /usr/bin/python3.12 (3.12.3), glibc 2.39"
    assert result.out.splitlines() == [
        "ok  program           /opt/criu/bin/criu",
        "ok  version           4.2.1",
        "ok  processes         of the user 1000 alone",
        "ok  dump and restore  a process with a UDP socket was dumped, restored and went on",
        "ok  kernel            6.18.44 on x86_64",
        f"ok  same elsewhere    {python}, 3 processor features",
        "ok  to other hosts    images can be sent and fetched",
    ]


def test_without_the_libraries_of_a_transfer_no_image_can_be_sent(rosrm, here, monkeypatch):
    """A host with CRIU but without these libraries is neither source nor destination of a move."""
    here()
    monkeypatch.setattr(
        "rosrm_criu.transfer.missing", lambda: "cryptography is not installed: pip ..."
    )
    result = rosrm("criu", "check")
    assert result.code == 1
    assert (
        result.out.splitlines()[-1]
        == "NO  to other hosts    cryptography is not installed: pip ..."
    )


def test_a_criu_that_does_not_work_is_reported_with_the_remedy(rosrm, here):
    here("it has no right. `sudo setcap ...` gives it", "4.1.1")
    result = rosrm("criu", "check")
    assert result.code == 1
    assert [line for line in result.out.splitlines() if line.startswith("NO")] == [
        "NO  version           4.1.1 (4.2 or newer is meant)",
        "NO  dump and restore  it has no right. `sudo setcap ...` gives it",
    ]


def test_a_missing_criu_is_reported_in_one_line(rosrm, here):
    here(missing="there is no CRIU here. `install_criu.sh` installs one")
    result = rosrm("criu", "check")
    assert (result.code, result.err) == (1, "")
    said = "there is no CRIU here. `install_criu.sh` installs one"
    assert result.out.splitlines()[0] == f"NO  program           {said}"


def test_as_json_it_has_all_that_a_program_needs(rosrm, here):
    here("no", "4.1.1")
    result = rosrm("criu", "check", "--json", "--prefix", "/opt/criu")
    assert result.code == 1
    assert json.loads(result.out) == {
        "program": "/opt/criu/bin/criu",
        "works": False,
        "no_transfer": "",
        "reason": "no",
        "facts": {**HOST_FACTS, "version": "4.1.1"},
    }


def test_as_json_there_is_no_program_where_there_is_none(rosrm, here):
    here(missing="none")
    result = rosrm("criu", "check", "--json")
    expected = {
        "program": None, "works": False, "no_transfer": "", "reason": "none", "facts": {}
    }  # fmt: skip
    assert json.loads(result.out) == expected
