"""Options of ECharts for the picture of the timeline, with the functions that draw its shapes.

The functions are JavaScript. Each draws one of the shapes of `timeline.Picture`, whose numbers and
texts it reads by their position.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final

from rosrm_web.page.timeline import Picture

#: Rows of the height of the picture, so that few bars are not too high.
_LEAST_ROWS: Final = 12
#: Rows that are visible at once; a slider shows the others.
_MOST_ROWS: Final = 30
#: Colours of bars, in light and in dark, in the order of `STYLES`.
COLOURS: Final = (
    ("#9fc5e8", "#2b5f94"), ("#a8dadc", "#2f6f73"), ("#cdb4f0", "#5b3f8c"), ("#ffd180", "#7a5200"),
    ("#f4a6a6", "#8c2f2f"), ("#d5dae0", "#4a5058"),
)  # fmt: skip

#: Begin of each function: the colours of the scheme, and the place of the drawing.
_BEGIN: Final = f"""
const dark = document.body.classList.contains('body--dark') ? 1 : 0;
const colours = {json.dumps(COLOURS)}, ink = ['#1d1d1d', '#f0f0f0'][dark];
const red = ['#b00020', '#ff8a80'][dark];
"""
_PLACE: Final = """
const area = params.coordSys, right = area.x + area.width, low = area.y + area.height;
const height = api.size([0, 1])[1];
const at = (time) => time ? Math.min(Math.max(api.coord([time, 0])[0], area.x), right) : right;
const row = (number) => api.coord([0, number])[1];
const text = (number) => api.ordinalRawValue(number);
"""


def _function(body: str) -> str:
    return f"(params, api) => {{{_BEGIN}{_PLACE}{body}}}"


_LANE: Final = _function("""
const top = row(api.value(1)), tall = height * api.value(2);
if (top + tall <= area.y || top >= low) return null;
const line = Math.min(Math.max(top, area.y), top + tall - 16);
return {type: 'group', children: [
  {type: 'rect', shape: {x: area.x, y: top, width: area.width, height: tall},
   style: {fill: ink, opacity: api.value(3) ? 0.03 : 0.08}},
  {type: 'text', z2: 20, silent: true,
   style: {text: text(5), x: area.x + 4, y: line + 2, fill: ink, font: 'bold 12px sans-serif'}},
]};
""")
_BAR: Final = _function("""
const left = at(api.value(0)), width = Math.max(at(api.value(1)) - left, 1);
const top = row(api.value(2)) + height * 0.08, tall = height * 0.84;
if (top + tall <= area.y || top >= low) return null;
const bar = {type: 'rect', shape: {x: left, y: top, width, height: tall, r: 2},
             style: {fill: colours[api.value(3)][dark]}};
if (width > 24 && tall > 8) {
  bar.textConfig = {position: 'insideLeft'};
  bar.textContent = {type: 'text', style: {text: text(4), fill: ink, width: width - 8,
                     overflow: 'truncate', font: '11px sans-serif'}};
}
return bar;
""")
_MOVE: Final = _function("""
const x = at(api.value(0)), from = row(api.value(1) + 0.5), to = row(api.value(2) + 0.5);
const head = to > from ? -7 : 7;
return {type: 'group', children: [
  {type: 'line', shape: {x1: x, y1: from, x2: x, y2: to}, style: {stroke: ink, lineWidth: 1.5}},
  {type: 'polygon', shape: {points: [[x, to], [x - 4, to + head], [x + 4, to + head]]},
   style: {fill: ink}},
]};
""")
_FAILURE: Final = _function("""
const x = at(api.value(0)), y = row(api.value(1) + 0.5);
return {type: 'path', shape: {pathData: 'M-5 -5L5 5M5 -5L-5 5'}, x, y,
        style: {stroke: red, lineWidth: 2.5, fill: 'none'}};
""")
_SPAN: Final = _function("""
const left = at(api.value(0)), width = Math.max(at(api.value(1)) - left, 1);
const top = row(api.value(2)), tall = height * api.value(3), gone = tall > 0;
return {type: 'rect', shape: {x: left, y: gone ? top : top - 3, width, height: gone ? tall : 3},
        style: {fill: red, opacity: gone ? 0.25 : 1}};
""")
_TIP: Final = """(params) => {
const value = params.value, time = (ms) => new Date(ms).toLocaleTimeString();
const spans = ['bars', 'spans'].includes(params.seriesId);
const end = spans ? ` to ${value[1] ? time(value[1]) : 'now'}` : '';
const lines = `${value[4]} ${value[5]}`.trim().replace(/(.{1,50})(\\s+|$)/g, '$1\\n');
return `${lines}${time(value[0])}${end}`;
}"""
_INK: Final = f"() => {{{_BEGIN} return ink; }}"
#: The order is that of drawing.
_SERIES: Final[Mapping[str, str]] = {
    "lanes": _LANE, "spans": _SPAN, "bars": _BAR, "moves": _MOVE, "failures": _FAILURE,
}  # fmt: skip
_SHAPE: Final = (
    "x", "a", "b", "c",
    {"name": "process", "type": "ordinal"}, {"name": "text", "type": "ordinal"},
)  # fmt: skip


def options() -> dict[str, Any]:
    """Return the options of an empty picture."""
    return {
        "animation": False,
        "grid": {"left": 4, "right": 28, "top": 4, "bottom": 52},
        # Rich text is drawn, and never read as HTML.
        "tooltip": {"renderMode": "richText", "confine": True, ":formatter": _TIP},
        "xAxis": {
            "type": "time", "min": 0, "max": 1, "axisLine": {"onZero": False},
            "axisLabel": {"hideOverlap": True, ":color": _INK},
        },
        "yAxis": {"type": "value", "inverse": True, "min": 0, "max": 1, "show": False},
        "dataZoom": [
            {"id": "time", "type": "slider", "xAxisIndex": 0, "filterMode": "none", "height": 18,
             "bottom": 6, "showDetail": False, "brushSelect": False},
            {"id": "wheel", "type": "inside", "xAxisIndex": 0, "filterMode": "none"},
            {"id": "rows", "type": "slider", "yAxisIndex": 0, "filterMode": "none", "width": 16,
             "right": 4, "maxValueSpan": _MOST_ROWS, "showDetail": False, "brushSelect": False},
            {"id": "drag", "type": "inside", "yAxisIndex": 0, "filterMode": "none",
             "maxValueSpan": _MOST_ROWS, "zoomOnMouseWheel": False, "moveOnMouseWheel": "shift"},
        ],
        "series": [
            {"id": name, "type": "custom", "clip": True, "dimensions": list(_SHAPE),
             "encode": {"x": 0, "y": 2, "tooltip": []}, "silent": name == "lanes",
             ":renderItem": drawn, "data": []}
            for name, drawn in _SERIES.items()
        ],
    }  # fmt: skip


def fill(shown: dict[str, Any], made: Picture) -> None:
    """Set the shapes of a picture in its options."""
    shown["yAxis"]["max"] = max(made.rows, _LEAST_ROWS)
    shown["dataZoom"][2]["show"] = made.rows > _MOST_ROWS
    shapes = (made.lanes, made.spans, made.bars, made.moves, made.failures)
    for series, data in zip(shown["series"], shapes, strict=True):
        series["data"] = data


def style() -> str:
    """Return the CSS of the legend."""
    return "\n".join(
        f"{scheme} .rosrm-bar-{number} {{ background: {colour} }}"
        for at, scheme in enumerate((".body--light", ".body--dark"))
        for number, colour in enumerate(one[at] for one in COLOURS)
    )
