"""Plugin hook that registers the scoring policies.

The hook imports them, with numpy, when a master calls it. Slaves import only this module.
"""

from __future__ import annotations

from collections.abc import Sequence

from rosrm import ScoringOffer, hookimpl


@hookimpl
def register_scoring_policies() -> Sequence[ScoringOffer]:
    """Offer `weighted`, the paper's policy, `threshold` near limits, and `network` for flows."""
    from rosrm_scoring.network import Network, NetworkOptions  # noqa: PLC0415 - see above
    from rosrm_scoring.threshold import Threshold, ThresholdOptions  # noqa: PLC0415
    from rosrm_scoring.weighted import Weighted, WeightedOptions  # noqa: PLC0415

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
