"""Undo of a lab that could not be made."""

from __future__ import annotations

import pytest

from rosrm.errors import LabError
from rosrm_lab import lab


def test_the_reason_why_a_lab_was_not_made_stays_known():
    """If the remains of the lab cannot be removed either, the error has both reasons."""

    def remove() -> None:
        raise LabError("host a of lab x did not end within 10 s")

    with pytest.raises(LabError) as raised:
        lab._undo(LabError("no netem"), remove)
    assert str(raised.value) == (
        "no netem; then the lab could not be removed: host a of lab x did not end within 10 s. "
        "`rosrm lab down` tries again"
    )
