"""Plugin hook that registers the scoring policies."""

from __future__ import annotations

from collections.abc import Sequence

from rosrm import ScoringOffer, hookimpl
from rosrm_scoring.network import Network, NetworkOptions
from rosrm_scoring.threshold import Threshold, ThresholdOptions
from rosrm_scoring.weighted import Weighted, WeightedOptions


@hookimpl
def register_scoring_policies() -> Sequence[ScoringOffer]:
    """Offer `weighted`, the paper's policy, `threshold` near limits, and `network` for flows."""
    return [
        ScoringOffer(
            name="weighted",
            create=Weighted,
            options=WeightedOptions,
            summary="weight x usage, summed over the resources",
        ),
        ScoringOffer(
            name="threshold",
            create=Threshold,
            options=ThresholdOptions,
            summary="as weighted, with a steep cost near a limit and a veto at it",
        ),
        ScoringOffer(
            name="network",
            create=Network,
            options=NetworkOptions,
            summary="keeps flows local, and links below their limits",
            reads=("talks_to",),
        ),
    ]
