"""Starts of processes that cannot work; the supervisor survives each of them."""

from __future__ import annotations

import os

import pytest

from rosrm.supervisor.spawn import SpawnError, spawn


@pytest.mark.parametrize(
    ("argv", "environment", "directory", "said"),
    [
        (("true",), {"PATH": "/bin"}, "/no/such", "working directory '/no/such' cannot be entered"),
        (("true",), {"PATH": "/bin"}, "/tmp/\0", "working directory .* cannot be entered"),
        (("true",), {"PATH": "/bin"}, "/\ud800", "working directory .* cannot be entered"),
        (("/no/such",), {}, "/", "no executable '/no/such' exists"),
        (("true", "\0"), {"PATH": "/bin"}, "/", "'true' cannot be started: embedded null"),
        (("true", "\ud800"), {"PATH": "/bin"}, "/", "'true' cannot be started: .* encode"),
    ],
)
def test_an_impossible_start_is_explained(argv, environment, directory, said):
    null = os.open(os.devnull, os.O_RDWR)
    try:
        with pytest.raises(SpawnError, match=said):
            spawn(argv, environment, directory, null, null)
    finally:
        os.close(null)
