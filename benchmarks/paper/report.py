"""Results of a figure as a file: its numbers, and the conditions of the measurement."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from benchmarks.machine import machine, versions

#: In the order of the paper.
FIGURES: Final = ("fig6", "fig7", "fig8", "fig9", "fig10", "table3", "fig11")
#: Figures that are measured several times.
REPEATED: Final = ("fig6", "fig7", "fig8", "fig9", "fig10")


@dataclass(frozen=True)
class Result:
    """A figure that was measured.

    Attributes:
        wrong: objections to the claim, as sentences; empty: it holds.
        figures: numbers, plain, by the keys of the JSON file.
        scaled: the differences from the paper's setting, with reasons.
        draw: writes the picture to a path.
        runs: how often it was measured.
        source: what `rosrm report` reads, of the run that the picture shows; None: no processes.
    """

    wrong: list[str]
    figures: Mapping[str, Any]
    scaled: Mapping[str, str]
    draw: Callable[[Path], None]
    runs: int = 1
    source: Path | None = None


@dataclass(frozen=True)
class Options:
    """The options of a measurement.

    Attributes:
        folder: for settings, logs and records, removed afterwards.
        runs: of each figure, and of each case of Table III.
        drives: to be mapped for Table III; empty: those available.
        small: measure so little that it only shows that the measurement works.
        lab: prefix of the names of labs.
    """

    folder: Path
    runs: int = 3
    drives: tuple[str, ...] = field(default_factory=tuple)
    small: bool = False
    lab: str = "paper"


def plain_report(
    name: str, claim: str, result: Result, *, small: bool, seconds: float, load_before: float
) -> dict[str, Any]:
    """Return the content of a figure's JSON file.

    Args:
        name: of the figure.
        claim: in words.
        result: what was measured.
        small: the run only shows that the measurement works.
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
