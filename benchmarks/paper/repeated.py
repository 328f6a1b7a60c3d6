"""Several runs of one figure as one result: the median run, and the range of all."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import Any

from benchmarks.paper.report import Result


def combined(results: Sequence[Result], names: Sequence[str]) -> Result:
    """Return the run with the median of the first number, with the spread of each named number.

    The objections to every run count.

    Args:
        results: of the runs, in order.
        names: of numbers in their `figures`.
    """
    ordered = sorted(results, key=lambda one: float(one.figures[names[0]]))
    middle = ordered[(len(ordered) - 1) // 2]
    wrong = [
        f"run {number}: {reason}"
        for number, one in enumerate(results, start=1)
        for reason in one.wrong
    ]
    spread = {name: _spread([one.figures[name] for one in results]) for name in names}
    return Result(
        wrong,
        {**middle.figures, "spread": spread},
        middle.scaled,
        middle.draw,
        len(results),
        middle.source,
    )


def _spread(values: Sequence[float]) -> dict[str, Any]:
    return {
        "median": median(values),
        "least": min(values),
        "most": max(values),
        "runs": list(values),
    }
