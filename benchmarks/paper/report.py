"""What every figure leaves: its numbers, and what they were measured on."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from benchmarks.machine import machine, versions

#: In the order of the paper.
FIGURES: Final = ("fig6", "fig7", "fig8", "fig9", "fig10", "table3")


@dataclass(frozen=True)
class Result:
    """A figure that was measured.

    Attributes:
        wrong: in words, what speaks against the claim; empty: it holds.
        figures: numbers, plain, by the keys of the JSON file.
        scaled: what differs from the paper's setting, and why.
        runs: how often it was measured.
        draw: writes the picture to a path.
    """

    wrong: list[str]
    figures: Mapping[str, Any]
    scaled: Mapping[str, str]
    draw: Callable[[Path], None]
    runs: int = 1


@dataclass(frozen=True)
class Options:
    """How a figure is measured.

    Attributes:
        folder: for settings, logs and records, removed afterwards.
        runs: of each case of Table III.
        drives: to be mapped for Table III; none: what is there.
        small: so small that it only shows that it works.
        lab: what the names of labs begin with.
    """

    folder: Path
    runs: int = 3
    drives: tuple[str, ...] = field(default_factory=tuple)
    small: bool = False
    lab: str = "paper"


def plain_report(
    name: str, claim: str, result: Result, *, small: bool, seconds: float, load_before: float
) -> dict[str, Any]:
    """All that the JSON file of a figure holds.

    Args:
        name: of the figure.
        claim: in words.
        result: what was measured.
        small: whether only to show that it works.
        seconds: that it took.
        load_before: average of the machine's load over the minute before.
    """
    return {
        "figure": name,
        "claim": claim,
        "claim_holds": not result.wrong,
        "against_it": result.wrong,
        "small": small,
        **result.figures,
        "scaled": dict(result.scaled),
        "runs": result.runs,
        "seconds": round(seconds, 1),
        "load_average_before": round(load_before, 2),
        "machine": machine(),
        "versions": versions(),
    }


def write_report(out: Path, name: str, report: Mapping[str, Any]) -> None:
    """Write NAME.json."""
    (out / f"{name}.json").write_text(json.dumps(report, indent=1) + "\n")
