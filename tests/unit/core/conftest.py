"""How long the state machine test plays: `ROSRM_PLAY=long` for minutes, to shake bugs out."""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings

_COMMON = {"deadline": None, "suppress_health_check": list(HealthCheck)}
# The short one plays the same each time: what fails in it was broken by the change in hand.
settings.register_profile(
    "short", max_examples=60, stateful_step_count=50, derandomize=True, **_COMMON
)
settings.register_profile("long", max_examples=3000, stateful_step_count=80, **_COMMON)
settings.load_profile(os.environ.get("ROSRM_PLAY", "short"))
