"""Hypothesis profiles of the state machine tests: `ROSRM_PLAY=long` runs for minutes."""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings

_COMMON = {"deadline": None, "suppress_health_check": list(HealthCheck)}
# The short profile is deterministic: a failure in it comes from the current change.
settings.register_profile(
    "short", max_examples=60, stateful_step_count=50, derandomize=True, **_COMMON
)
settings.register_profile("long", max_examples=3000, stateful_step_count=80, **_COMMON)
settings.load_profile(os.environ.get("ROSRM_PLAY", "short"))
