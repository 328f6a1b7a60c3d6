"""Pictures of a report as SVG, with colours by the classes of page.css. Pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

from rosrm.timeline.lanes import lanes
from rosrm.timeline.values import Failure, HostSpan, Move, Placement
from rosrm.wording import duration, sanitized, words
from rosrm_report.model import Readings

#: Number of colours in page.css.
_COLOURS: Final = 8
_WIDTH, _LEFT, _RIGHT, _AXIS = 1000.0, 110.0, 12.0, 24.0
_BAR, _GAP = 9.0, 12.0
#: Bars of a timeline; of more, the longest are drawn.
MOST_BARS: Final = 3000
#: Rows of a host; further bars at the same time are left out.
_MOST_ROWS: Final = 60
#: Moves and failures that are drawn.
MOST_MARKS: Final = 1000
#: Curves of a picture, and points of a curve.
MOST_CURVES: Final = 24
_MOST_POINTS: Final = 500
_CURVES_HEIGHT: Final = 180.0


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture and the number of things that its bounds left out."""

    text: str
    omitted: int = 0


class _Scale:
    """Horizontal position of a time."""

    def __init__(self, length: float) -> None:
        self._length = length or 1.0

    def __call__(self, time: float) -> float:
        share = min(max(time / self._length, 0.0), 1.0)
        return round(_LEFT + share * (_WIDTH - _LEFT - _RIGHT), 1)

    def axis(self, height: float) -> str:
        """Return the axis of time at the bottom."""
        step = _step(self._length)
        parts = []
        for at in range(int(self._length / step) + 1):
            x, label = self(at * step), clock(at * step)
            parts.append(
                f'<line class="grid" x1="{x}" x2="{x}" y1="0" y2="{height - _AXIS + 4}"/>'
                f'<text x="{x}" y="{height - 6}" text-anchor="middle">{label}</text>'
            )
        return "".join(parts)


def clock(seconds: float) -> str:
    """Return a time since the beginning: 7, 1:05, 1:02:03 or 2 d 1:02:03."""
    whole = int(seconds)
    days, rest = divmod(whole, 86_400)
    hours, rest = divmod(rest, 3600)
    minutes, left = divmod(rest, 60)
    if whole < 60:
        return f"{seconds:.3g} s" if seconds != whole else f"{whole} s"
    text = f"{hours}:{minutes:02}:{left:02}" if hours or days else f"{minutes}:{left:02}"
    return f"{days} d {text}" if days else text


def _step(length: float) -> float:
    """Return a distance of marks on the axis of time that gives 5 to 12 of them."""
    steps = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200)
    days = (14_400, 21_600, 43_200, 86_400, 172_800, 432_000, 864_000, 2_592_000)
    return next((one for one in (*steps, *days) if length / one <= 12), length)


def _whole(title: str, description: str, height: float, content: str, name: str) -> str:
    return (
        f'<svg id="{name}" role="img" viewBox="0 0 {_WIDTH:.0f} {height:.0f}" '
        f'aria-labelledby="{name}-title {name}-text"><title id="{name}-title">{_clean(title)}'
        f'</title><desc id="{name}-text">{_clean(description, 4000)}</desc>{content}</svg>'
    )


def _clean(text: str, most: int = 300) -> str:
    return escape(sanitized(text, most))


def _tip(text: str) -> str:
    return f"<title>{_clean(text)}</title>"


def _label(text: str, y: float) -> str:
    return f'<text x="{_LEFT - 8}" y="{y}" text-anchor="end">{_clean(text, 16)}{_tip(text)}</text>'


# --- timeline ---------------------------------------------------------------------------------


def timeline(
    hosts: Sequence[str], placements: Sequence[Placement], moves: Sequence[Move],
    failures: Sequence[Failure], spans: Sequence[HostSpan], length: float,
) -> Picture:  # fmt: skip
    """Return the processes over the hosts: a band for each host, a bar for each placement.

    Args:
        hosts: in the order of their bands.
        spans: times in which hosts were gone or over a limit.
    """
    scale = _Scale(length)
    longest = sorted(placements, key=lambda one: one.begin - one.end)[:MOST_BARS]
    rows = lanes(longest)
    y, bands, content = 4.0, dict[str, tuple[float, float]](), []
    for number, host in enumerate(hosts):
        bars = rows.get(host, [])
        count = min(max((row for row, _ in bars), default=0) + 1, _MOST_ROWS)
        height = max(count * _BAR, 2 * _BAR)
        bands[host] = (y, height)
        content.append(
            f'<rect class="band" x="{_LEFT}" y="{y}" width="{_WIDTH - _LEFT - _RIGHT}" '
            f'height="{height}"/>{_label(host, y + height / 2 + 4)}'
        )
        content += [
            _bar(scale, one, y + row * _BAR, number % _COLOURS)
            for row, one in bars
            if row < _MOST_ROWS
        ]
        y += height + _GAP
    content += [_span(scale, one, *bands[one.host]) for one in spans if one.host in bands]
    arrows = [one for one in moves[:MOST_MARKS] if one.done and not one.within]
    content += [_arrow(scale, one, bands) for one in arrows]
    content += [_cross(scale, one, bands) for one in failures[:MOST_MARKS] if one.host in bands]
    height = y + _AXIS
    drawn = sum(row < _MOST_ROWS for bars in rows.values() for row, _ in bars)
    description = (
        f"{len(hosts)} hosts, {drawn} bars, one for each time of a process on a host; the table "
        f"below has the same times."
    )
    whole = _whole(
        "Processes over hosts", description, height, scale.axis(height) + "".join(content),
        "timeline",
    )  # fmt: skip
    return Picture(whole, len(placements) - drawn)


def _bar(scale: _Scale, one: Placement, y: float, colour: int) -> str:
    x, width = scale(one.begin), max(scale(one.end) - scale(one.begin), 1.0)
    ended = f", then {words(one.ended_by)}" if one.ended_by else ""
    tip = _tip(
        f"{one.process} on {one.host}: {clock(one.begin)} to {clock(one.end)} "
        f"({duration(one.end - one.begin)}){ended}"
    )
    name = ""
    if width > 6.0 * len(one.process) + 4:
        name = f'<text class="name" x="{x + 3}" y="{y + 7}">{_clean(one.process)}</text>'
    return (
        f'<g><rect class="c{colour}" x="{x}" y="{y + 0.5}" width="{width:.1f}" '
        f'height="{_BAR - 1}" rx="1.5"/>{name}{tip}</g>'
    )


def _span(scale: _Scale, one: HostSpan, y: float, height: float) -> str:
    gone = one.is_gone
    x, width = scale(one.begin), max(scale(one.end) - scale(one.begin), 1.0)
    times = f"{clock(one.begin)} to {clock(one.end)}"
    place = f'y="{y}" height="{height}"' if gone else f'y="{y + height + 1}" height="3"'
    return (
        f'<rect class="{"gone" if gone else "over"}" x="{x}" width="{width:.1f}" {place}>'
        f"{_tip(f'{one.phrase}: {times}')}</rect>"
    )


def _arrow(scale: _Scale, move: Move, bands: Mapping[str, tuple[float, float]]) -> str:
    if move.source not in bands or move.destination not in bands:
        return ""
    x, (top, high), (other, low) = scale(move.time), bands[move.source], bands[move.destination]
    begin, end = (top + high, other) if other > top else (top, other + low)
    head = 4 if end > begin else -4
    tip = _tip(
        f"{move.process}: {move.source} to {move.destination} at {clock(move.time)}, "
        f"{move.how}: {move.cause}"
    )
    return (
        f'<g class="move"><line x1="{x}" x2="{x}" y1="{begin}" y2="{end}"/>'
        f'<path d="M{x - 3} {end - head}L{x} {end}L{x + 3} {end - head}"/>{tip}</g>'
    )


def _cross(scale: _Scale, failure: Failure, bands: Mapping[str, tuple[float, float]]) -> str:
    x, y = scale(failure.time), sum(bands[failure.host]) - 4
    tip = _tip(f"{clock(failure.time)}: {failure.message}")
    return (
        f'<g class="failure"><path d="M{x - 4} {y - 4}L{x + 4} {y + 4}M{x + 4} {y - 4}'
        f'L{x - 4} {y + 4}"/>{tip}</g>'
    )


# --- curves -----------------------------------------------------------------------------------


def usage(readings: Readings, resource: str, hosts: Sequence[str], length: float) -> Picture:
    """Return the usage of a resource over time, a curve for each host, with the limits.

    Args:
        hosts: all, in the order of their colours; of many, those with the highest peaks are drawn.
    """
    scale, curves = _Scale(length), readings.usage[resource]
    peaks = {
        host: max((v for v in of if v is not None), default=0.0) for host, of in curves.items()
    }
    shown = sorted(peaks, key=lambda host: -peaks[host])[:MOST_CURVES]
    most = max(1.0, *(peaks[host] for host in shown)) if shown else 1.0
    height = _CURVES_HEIGHT + _AXIS

    def at(value: float) -> float:
        return round(4 + (1 - value / most) * (_CURVES_HEIGHT - 4), 1)

    content = [scale.axis(height)]
    content += [
        f'<text x="{_LEFT - 8}" y="{at(share) + 4}" text-anchor="end">{share * 100:.0f} %</text>'
        for share in (0.0, 0.5, 1.0)
    ]
    limits = {readings.limits.get(resource, {}).get(host) for host in shown} - {None, 1.0}
    for limit in sorted(one for one in limits if one is not None):
        y = at(limit)
        content.append(f'<line class="limit" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y}" y2="{y}">'
                       f"{_tip(f'limit {limit * 100:.0f} %')}</line>")  # fmt: skip
    for host in shown:
        colour = hosts.index(host) % _COLOURS if host in hosts else 0
        points = _thinned(readings.times, curves[host])
        tip = _tip(f"{host}: at most {peaks[host] * 100:.0f} %")
        content.append(f'<path class="curve k{colour}" d="{_path(scale, at, points)}">{tip}</path>')
    description = f"Usage of {resource} of {len(shown)} hosts. " + "; ".join(
        f"{host}: at most {peaks[host] * 100:.0f} %" for host in shown
    )
    title = f"Usage of {resource}"
    whole = _whole(title, description, height, "".join(content), f"usage-{id_of(resource)}")
    return Picture(whole, len(curves) - len(shown))


def id_of(name: str) -> str:
    """Return a name as a part of an id in HTML."""
    return "".join(one if one.isalnum() and one.isascii() else f"_{ord(one):x}" for one in name)


_Points = list[tuple[float, float | None]]


def _thinned(times: Sequence[float], values: Sequence[float | None]) -> _Points:
    """Return at most `_MOST_POINTS` points; of several, the highest, so that no peak is lost."""
    together = max(1, -(-len(times) // _MOST_POINTS))
    points: _Points = []
    for at in range(0, len(times), together):
        part = [(v, t) for t, v in zip(times[at : at + together], values[at : at + together],
                                       strict=True) if v is not None]  # fmt: skip
        value, time = max(part) if part else (None, times[at])
        points.append((time, value))
    return points


def _path(scale: _Scale, at: Callable[[float], float], points: _Points) -> str:
    parts, pen = [], False
    for time, value in points:
        if value is None:
            pen = False
            continue
        parts.append(f"{'H' if pen else 'M'}{scale(time)}{'V' if pen else ' '}{at(value)}")
        pen = True
    return "".join(parts)


def queue(lengths: Sequence[tuple[float, int]], length: float) -> Picture:
    """Return the number of waiting processes over time."""
    scale, height = _Scale(length), 90.0 + _AXIS
    most = max((one for _, one in lengths), default=0)
    points = _thinned([t for t, _ in lengths], [float(n) for _, n in lengths])

    def at(value: float) -> float:
        return round(6 + (1 - value / max(most, 1)) * 82, 1)

    path = f"M{_LEFT} {at(0)}"
    for time, value in points:
        path += f"H{scale(time)}V{at(value or 0.0)}"
    path += f"H{scale(length)}V{at(0)}Z"
    content = (
        f'{scale.axis(height)}<text x="{_LEFT - 8}" y="12" text-anchor="end">{most}</text>'
        f'<text x="{_LEFT - 8}" y="{at(0) + 4}" text-anchor="end">0</text>'
        f'<path class="queue" d="{path}"/>'
    )
    description = f"Number of processes that wait for a host; at most {most}."
    return Picture(_whole("Queue", description, height, content, "queue-length"))
