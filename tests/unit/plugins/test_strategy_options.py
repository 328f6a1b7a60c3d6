"""Options of a strategy in a work file."""

from __future__ import annotations

import pytest

from rosrm.extensions.options import options_of
from rosrm.model.values import MigrationPolicy, ProcessSpec
from rosrm_criu.options import CriuOptions, OwnCriuOptions


def options(**given: object) -> OwnCriuOptions:
    """Return a process's options, merged over those of a cluster."""
    spec = ProcessSpec("p", migration=MigrationPolicy("criu", options=given))
    return options_of(spec, CriuOptions(dump_timeout=7.0), OwnCriuOptions)


def test_units_are_understood_where_whoever_submits_has_no_plugin() -> None:
    """`rosrm submit` sends the values as written, with or without a `rosrm config check`."""
    assert options(checkpoint_every="1min", max_rate="20MB", reserve=5) == OwnCriuOptions(
        dump_timeout=7.0, checkpoint_every=60.0, max_rate=20_000_000, reserve=5
    )


def test_an_unknown_unit_is_refused_with_the_name_of_the_option() -> None:
    """The error also has the allowed units."""
    with pytest.raises(ValueError, match=r"leave_timeout: unknown unit 'sec'.*Allowed: us, ms"):
        options(leave_timeout="3sec")
