"""Writer of the results into `docs/evaluation.md`: the text between each figure's two marks.

<!-- fig6 -->
(what this module writes)
<!-- /fig6 -->
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from benchmarks.paper.report import FIGURES
from rosrm.errors import RosrmError

_Report = Mapping[str, Any]


def update_page(page: Path, results: Path, names: Iterable[str]) -> None:
    """Write figures that were measured into a page.

    Args:
        page: with a pair of marks for each figure.
        results: folder with FIGURE.json and FIGURE.png.
        names: of the figures; the others stay as they are.

    Raises:
        RosrmError: the page lacks the marks of a figure.
    """
    text = checked_page(page)
    for name in names:
        report = json.loads((results / f"{name}.json").read_text(encoding="utf-8"))
        picture = os.path.relpath(results / f"{name}.png", page.parent)
        text = replaced(text, name, section(name, report, picture))
    page.write_text(text, encoding="utf-8")


def checked_page(page: Path) -> str:
    """Return the text of a page that has the marks of every figure; raises `RosrmError`."""
    text = page.read_text(encoding="utf-8")
    for name in FIGURES:
        if not _marked(name).search(text):
            raise RosrmError(
                f"--page {page}: there are no marks '<!-- {name} -->' and '<!-- /{name} -->', each "
                "on a line of its own; docs/evaluation.md has them"
            )
    return text


def _marked(name: str) -> re.Pattern[str]:
    return re.compile(rf"^(<!-- {name} -->\n).*?^(<!-- /{name} -->)$", re.DOTALL | re.MULTILINE)


def replaced(text: str, name: str, content: str) -> str:
    """Return a page with other content between the marks of a name."""
    return _marked(name).sub(lambda found: f"{found[1]}{content}{found[2]}", text)


def section(name: str, report: _Report, picture: str) -> str:
    """Return the text about one figure.

    Args:
        name: of the figure.
        report: content of its JSON file.
        picture: path of its picture, from the page.
    """
    lines = [*_ROWS[name](report), *_spread(report)]
    rows = "".join(f"| {what} | {paper} | {ours} |\n" for what, paper, ours in lines)
    verdict = "The claim holds." if report["claim_holds"] else "**The claim does not hold:** "
    reasons = "; ".join(report["against_it"])
    return (
        f"\n![{name}: {report['claim']}]({picture})\n\n"
        f"| | paper | here |\n|---|---|---|\n{rows}\n"
        f"{verdict}{reasons} {_measured_on(report)}\n\n"
    )


def _measured_on(report: _Report) -> str:
    machine, runs = report["machine"], report["runs"]
    often = "one run" if runs == 1 else f"median of {runs} runs"
    if "spread" in report:
        often = f"the median one of {runs} runs"
    return (
        f"({often}, {report['seconds']:.0f} s in all, load average {report['load_average_before']} "
        f"before; {machine['cores']} cores of {machine['processor']})"
    )


_Rows = list[tuple[str, str, str]]


def _spread(report: _Report) -> _Rows:
    """Return a row for each number of which several runs show the range."""
    return [
        (f"{_SPREAD[name]}: median and range of all runs", "",
         f"{one['median']:g}, {one['least']:g} to {one['most']:g}")
        for name, one in report.get("spread", {}).items()
    ]  # fmt: skip


_SPREAD: Final = {
    "processes": "processes placed",
    "widest_gap_points": "slaves apart, at most, points",
    "gap_at_the_end_points": "slaves apart at the end, points",
    "slope": "processes a slave",
    "r2": "R² of the line",
    "highest_percent": "highest utilization of a slave, %",
    "slope_us": "µs a slave",
    "intercept_us": "µs beside",
    "moves": "migrations",
    "longest_move_s": "longest migration, s",
}


def _fig6(report: _Report) -> _Rows:
    simulation = report["simulation"]
    ends = ", ".join(f"{one:.1f}" for one in report["memory_percent_at_the_end"].values())
    return [
        ("processes placed, and those that wait at the end", "until the limit",
         f"{report['processes']}, {report['waiting_at_the_end']}"),
        ("utilization at the end, %", "up to 80", ends),
        ("slaves apart, at most; the largest process, points", "balanced",
         f"{report['widest_gap_points']}; {report['largest_process_points']}"),
        ("`rosrm simulate` of this run: distance of the usage of the fullest, second, third slave",
         "", f"{100 * simulation['ranked']['memory']:.1f} points, mean over time"),
        ("replayed record: decisions, of them different", "",
         f"{simulation['replayed_decisions']}, {simulation['replayed_differently']}"),
    ]  # fmt: skip


def _fig7(report: _Report) -> _Rows:
    first = ", ".join(f"{one:.1f}" for one in report["first_process_s"].values())
    counts = ", ".join(str(one) for one in report["per_host"].values())
    return [
        ("slaves 2 and 3 are started at, s", "25, 75",
         ", ".join(f"{one:g}" for one in report["joins_s"])),
        ("first process on slave 1, 2, 3 at, s", "", first),
        ("processes on each at the end", "equally full", counts),
        ("slaves apart at the end; one process, points", "",
         f"{report['gap_at_the_end_points']}; {report['one_process_points']}"),
    ]  # fmt: skip


def _fig8(report: _Report) -> _Rows:
    return [
        ("slaves", "1 to 10", f"1 to {report['slaves'][-1]}"),
        ("processes held", "proportional", ", ".join(str(one) for one in report["processes"])),
        (
            "R² of the line; of that through the origin",
            "",
            f"{report['r2']:.5f}; {report['r2_through_origin']:.5f}",
        ),
        ("slaves that passed 80 %, and the highest", "", _beyond(report["over_limit_percent"])),
    ]


def _beyond(peaks: Mapping[str, float]) -> str:
    return f"{len(peaks)}, {max(peaks.values()):.1f} %" if peaks else "none"


def _fig9(report: _Report) -> _Rows:
    most, core = report["real"][-1], report["core"][-1]
    return [
        ("µs a slave (slope)", f"{report['paper_slope_us']:g}", f"{report['slope_us']:g}"),
        ("µs beside (intercept)", f"{report['paper_intercept_us']:g}",
         f"{report['intercept_us']:g}"),
        ("R² of the line", "", f"{report['r2']:.4f}"),
        (f"readings missed by the master, of {most['slaves']} slaves in one run", "",
         f"{most['missed']} of {most['cycles']}"),
        (f"one cycle with {most['slaves']} slaves, ms", "84.3, extrapolated",
         f"{most['ms']:.1f}, of that the decision {most['decision_ms']:.2f}"),
        (f"one cycle with {core['slaves']} hosts in the core alone, ms", "", f"{core['ms']:.2f}"),
    ]  # fmt: skip


def _fig10(report: _Report) -> _Rows:
    moves = report["migrations"]
    ways = "; ".join(
        f"{one['process']} at {one['s']:.0f} s from {one['from']} to {one['to']}" for one in moves
    )
    took = ", ".join(f"{one['took_s']:.2f}" for one in moves)
    return [
        ("migrations", "process 1 at 180 s from slave 1 to slave 3, at 300 s to slave 2", ways),
        ("each took, s", "", took),
    ]


def _table3(report: _Report) -> _Rows:
    paper = report["paper_min"]
    return [
        ("one host", f"{paper['one_host']} min", f"{report['one_host_s']:.1f} s"),
        ("10 hosts (ideal case)", f"{paper['ideal']} min", f"{report['ideal_s']:.1f} s"),
        ("10 hosts (with resource manager)", f"{paper['rosrm']} min",
         f"{report['rosrm_s']:.1f} s"),
        ("resource manager over ideal", f"{report['paper_ratio']}", f"{report['ratio']:.3f}"),
        ("one host over resource manager", f"{report['paper_speed_up']}",
         f"{report['speed_up']:.1f}"),
        ("from `submit` to the last process started, s", "",
         ", ".join(f"{one['last_started_s']:.2f}" for one in report["rosrm_spent"])),
        ("drives", "1 km", ", ".join(report["drives"])),
    ]  # fmt: skip


def _fig11(report: _Report) -> _Rows:
    hosts = ", ".join(f"{part['scans']} on {part['host']}" for part in report["parts"])
    return [
        ("scans mapped", "", f"{report['scans_processed']} of {report['scans_sent']}: {hosts}"),
        ("scans lost, mapped twice", "", f"{report['scans_lost']}, {report['scans_repeated']}"),
        ("pause beyond the period of the scans, ms", "", f"{report['gap_ms']}"),
        ("poses apart from a drive without a move, at most, m", "",
         f"{report['max_deviation_m']}"),
        ("drive", "", report["drive"]),
    ]  # fmt: skip


_ROWS: Final[Mapping[str, Callable[[_Report], _Rows]]] = {
    "fig6": _fig6, "fig7": _fig7, "fig8": _fig8, "fig9": _fig9, "fig10": _fig10, "table3": _table3,
    "fig11": _fig11,
}  # fmt: skip
