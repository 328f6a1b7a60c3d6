"""The master's services for contents of artifacts: rate, refusals, roles."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from rosrm import clocks
from rosrm.artifacts.store import ArtifactStore
from rosrm.errors import Refused
from rosrm.keys.roles import Principal, Role, may_send
from rosrm.ros.master.artifacts import MOST, ArtifactServices
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import srv

RATE = 4 * MOST  # bytes a second


class Opened:
    """A genuine request of a host or user."""

    run = bytes(16)
    peer = SimpleNamespace(grant=SimpleNamespace(principal=Principal("user", "ada")))

    def __init__(self) -> None:
        self.response = None

    def answer(self, response) -> None:
        self.response = response


class Services:
    """The services with a thread that works at once."""

    def __init__(self, store) -> None:
        self.handlers = {}
        settings = SimpleNamespace(namespace="/rosrm")
        endpoints = SimpleNamespace(
            participant=SimpleNamespace(settings=settings),
            serve=lambda kind, _name, handle: self.handlers.update({kind: handle}),
        )
        worker = SimpleNamespace(run=self.run)
        self.services = ArtifactServices(endpoints, store, worker, keep=frozenset, max_rate=RATE)

    @staticmethod
    def run(work, then, failed) -> None:
        try:
            outcome = work()
        except Refused as refusal:
            failed(refusal)
        else:
            then(outcome)

    def ask(self, kind, **fields):
        opened = Opened()
        request = kind.Request(**{"protocol_version": PROTOCOL_VERSION, **fields})
        self.handlers[kind](request, opened)
        return opened


@pytest.fixture
def services(tmp_path):
    return Services(ArtifactStore(tmp_path, 10**6))


def test_slaves_get_no_more_than_the_rate(services):
    """Requests wait for the rate, and are refused where they would wait longer than two seconds."""
    asked = [services.ask(srv.ReadArtifact, digest="0" * 64) for _ in range(20)]
    answered = [one for one in asked if one.response is not None]
    codes = [one.response.answer.code for one in answered]
    assert codes.count("unknown") == 1
    assert codes.count("busy") == len(codes) - 1 > 5
    waiting = [one for one in asked if one.response is None]
    assert 8 <= len(waiting) <= 10
    later = clocks.boot_time()
    for step in range(1, 60):
        services.services.advance(later + 0.05 * step)
    assert all(one.response.answer.code == "unknown" for one in waiting)


def test_a_request_of_another_version_is_refused(services):
    """The sender learns both versions."""
    opened = services.ask(srv.StoreArtifact, protocol_version=1, digest="0" * 64, size=5)
    assert opened.response.answer.code == "version"


def test_a_refusal_of_the_store_reaches_the_client(services):
    """With its code and its sentence."""
    answer = services.ask(srv.StoreArtifact, digest="0" * 64, size=10**7).response.answer
    assert (answer.accepted, answer.code) == (False, "full")
    assert "artifacts.max_size" in answer.message


@pytest.mark.parametrize(
    ("request_", "roles"),
    [("store_artifact", {Role.SUBMITTER, Role.OPERATOR}), ("read_artifact", {Role.HOST})],
)
def test_only_submitters_send_and_only_hosts_fetch(request_, roles):
    """All other roles are denied."""
    assert {role for role in Role if may_send(role, request_)} == roles
