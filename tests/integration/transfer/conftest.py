"""Fixtures of transfers: source, target, and both ends."""

from __future__ import annotations

import pytest

from rosrm_criu.transfer import Fetcher, Sender
from tests.integration.transfer.trees import PATIENCE, Destination, fill


@pytest.fixture
def source(tmp_path):
    """Return a directory with 4 MB of incompressible files."""
    directory = tmp_path / "source"
    fill(directory, megabytes=4)
    return directory


@pytest.fixture
def target(tmp_path):
    return tmp_path / "there" / "target"


@pytest.fixture
def sender():
    with Sender() as sender:
        yield sender


@pytest.fixture
def fetcher():
    with Fetcher() as fetcher:
        yield fetcher


@pytest.fixture
def destination():
    return Destination()


@pytest.fixture
def offer(source, sender, destination):
    """Return an offer of the source to the destination."""
    return sender.offer(source, seconds=PATIENCE, to=destination.certificate)
