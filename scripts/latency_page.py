"""Writer of the table and the picture of docs/explanation/latency.md from the stored result.

python -m benchmarks.latency --trace | tail -n 1 > benchmarks/results/latency-trace.json
python -m scripts.latency_page
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final
from xml.sax.saxutils import escape

from benchmarks.paper.page import replaced
from rosrm.client.start_traces import BESIDE

ROOT: Final = Path(__file__).resolve().parents[1]
RESULT: Final = ROOT / "benchmarks/results/latency-trace.json"
PAGE: Final = ROOT / "docs/explanation/latency.md"
PICTURE: Final = ROOT / "docs/pictures/start-trace.svg"
#: Name of the marks in the page.
_MARKS: Final = "hand-overs"

_COLOURS: Final = {
    "client": "#5b6c9d", "master": "#00798c", "slave": "#c98a1b", "supervisor": "#d1495b",
    "process": "#22303c",
}  # fmt: skip
_INK: Final = "#22303c"
_FAINT: Final = "#dddad2"
#: Width in pixels: of the picture, of the texts at its left, and of the figures at its right.
_WIDTH: Final = 820
_LEFT: Final = 220
_RIGHT: Final = 70
#: Height of a row in pixels.
_ROW: Final = 24

_Rows = Sequence[Mapping[str, Any]]


def main() -> None:
    """Write both."""
    report = json.loads(RESULT.read_text(encoding="utf-8"))
    PICTURE.write_text(picture(report["hand_overs"]), encoding="utf-8")
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replaced(text, _MARKS, section(report)), encoding="utf-8")


def section(report: Mapping[str, Any]) -> str:
    """Return the text between the marks of the page."""
    rows = "".join(
        f"| {row['event']} | {_ms(row['step_ms'])} | {_ms(row['since_submit_ms'])} |\n"
        for row in report["hand_overs"]
    )
    machine = report["machine"]
    return (
        f"\n![The hand-overs of a start](../pictures/{PICTURE.name})\n\n"
        f"| median of {report['runs']} starts | step, ms | since `submit`, ms |\n|---|---|---|\n"
        f"{rows}\n"
        f"In the same run a bare spawn of the program took {_ms(report['spawn_p50_ms'])} ms. "
        f"Client, master and three slaves ran on one machine,\nwith keys ({machine['cores']} cores "
        f"of {machine['processor']}, load average {machine['load_average']}).\n\n"
    )


def _ms(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def picture(rows: _Rows) -> str:
    """Return the hand-overs as bars over the time since the submission, in SVG."""
    ends = {row["stamp"]: row["since_submit_ms"] for row in rows}
    steps = [row for row in rows if row["stamp"] not in BESIDE][1:]
    longest = max(ends.values())
    height = _ROW * (len(steps) + 3)
    beside = [row for row in rows if row["stamp"] in BESIDE]
    bottom = _ROW * (len(steps) + 1)
    lines = [*_axis(longest, bottom), *_bars(steps, longest), *_beside(beside, longest, bottom)]
    body = "\n".join(f"  {line}" for line in lines)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" '
        f'font-family="sans-serif" font-size="12" fill="{_INK}">\n'
        f'  <rect width="{_WIDTH}" height="{height}" fill="white"/>\n{body}\n</svg>\n'
    )


def _x(ms: float, longest: float) -> float:
    return round(_LEFT + ms / longest * (_WIDTH - _LEFT - _RIGHT), 1)


def _text(x: float, y: float, text: str, anchor: str = "start") -> str:
    return f'<text x="{x}" y="{y}" text-anchor="{anchor}">{escape(text)}</text>'


def _line(x: float, bottom: int, colour: str, dash: str = "none") -> str:
    return (
        f'<line x1="{x}" y1="{_ROW}" x2="{x}" y2="{bottom}" stroke="{colour}" '
        f'stroke-dasharray="{dash}"/>'
    )


def _axis(longest: float, bottom: int) -> Iterator[str]:
    for ms in range(int(longest) + 1):
        x = _x(ms, longest)
        yield _line(x, bottom, _FAINT)
        yield _text(x, 16, f"{ms} ms" if ms == 0 else str(ms), "middle")


def _bars(steps: _Rows, longest: float) -> Iterator[str]:
    """Yield a bar for each step, from the end of the one before."""
    begin = 0.0
    for number, row in enumerate(steps, start=1):
        end, y = row["since_submit_ms"], _ROW * number
        part = row["event"].partition(":")[0]
        left, right = sorted((_x(begin, longest), _x(end, longest)))
        yield _text(_LEFT - 8, y + 16, row["event"], "end")
        yield (
            f'<rect x="{left}" y="{y + 4}" width="{round(max(right - left, 1.0), 1)}" '
            f'height="{_ROW - 8}" fill="{_COLOURS[part]}"/>'
        )
        yield _text(right + 5, y + 16, _ms(row["step_ms"]))
        begin = end


def _beside(rows: _Rows, longest: float, bottom: int) -> Iterator[str]:
    """Yield a dashed line for each stamp beside the order."""
    for number, row in enumerate(rows):
        x, y = _x(row["since_submit_ms"], longest), bottom + _ROW * number
        yield _line(x, y + 6, _INK, "4 3")
        yield _text(x - 5, y + 14, f"{row['event']}, {_ms(row['since_submit_ms'])}", "end")


if __name__ == "__main__":
    main()
