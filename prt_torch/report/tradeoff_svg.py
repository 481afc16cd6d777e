"""Trade-offs as drawings inside the page: every result a point that tells its figures.

Axes are logarithmic. A filled point was fitted, a hollow one read off a larger fit; lines join the
results of a family that no other of it beats, the broad one those that nothing beats. Colours come
from the page's style, so the drawings follow its light and dark.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

from prt_torch.report.numbers import (
    bytes_text,
    error_text,
    percent_text,
    seconds_text,
)
from prt_torch.report.outcome import Number
from prt_torch.report.plots import DARK, LIGHT
from prt_torch.tradeoff import COSTS, ERRORS, Stage, error_of, fronts

_WIDTH, _HEIGHT = 560, 380
_LEFT, _RIGHT, _TOP, _BOTTOM = 74, 16, 34, 28
_LOG2 = math.log10(2.0)
_BAR, _GAP, _BARS_LEFT, _BARS_WIDTH = 26, 12, 190, 560

SHAPES = ("circle", "square", "up", "diamond", "down", "cross", "star")
"""Of the families, beside their colours."""


def family_style(families: Sequence[str]) -> str:
    """Style sheet of the drawings, with the colours of the report's plots."""

    def colours(palette: Sequence[str]) -> str:
        return "".join(f"--family{at}: {one}; " for at, one in enumerate(palette))

    rules = "".join(
        f".family{at} {{ --own: var(--family{at % len(LIGHT.families)}); }}\n"
        for at in range(len(families))
    )
    return f"""
:root {{ {colours(LIGHT.families)} }}
@media (prefers-color-scheme: dark) {{ :root {{ {colours(DARK.families)} }} }}
{rules}
.plots {{ display: grid; gap: 12px; grid-template-columns: repeat(auto-fit, minmax(430px, 1fr)); }}
svg {{ display: block; width: 100%; height: auto; font-size: 11.5px; overflow: visible; }}
svg text {{ fill: var(--muted); }}
svg text.title {{ fill: var(--ink); font-weight: 600; }}
svg .grid {{ stroke: var(--line); }}
svg .front {{ fill: none; stroke: var(--own); stroke-width: 1.4; opacity: 0.75; }}
svg .joint {{ fill: none; stroke: var(--muted); stroke-width: 6; opacity: 0.25; }}
svg .mark {{ fill: var(--own); stroke: var(--own); stroke-width: 1.6; cursor: pointer; }}
svg .mark.read {{ fill: var(--card); }}
svg .mark:hover, svg .mark.hit {{ stroke: var(--ink); stroke-width: 3; }}
svg .more {{ fill: var(--family1); }} svg .less {{ fill: var(--family2); }}
svg .total {{ fill: var(--family0); }} svg .alone {{ fill: var(--muted); }}
tr.hit {{ background: color-mix(in srgb, var(--accent) 18%, transparent); }}
.legend {{ display: flex; flex-wrap: wrap; gap: 6px 18px; margin: 0 0 12px; }}
.legend svg {{ display: inline-block; width: 14px; height: 14px; margin-right: 6px;
  vertical-align: -2px; }}
#told {{ position: sticky; bottom: 0; padding: 8px 14px; min-height: 2.6em; font-size: 13px;
  font-variant-numeric: tabular-nums; }}
"""


TELLING = """
const told = document.getElementById("told");
for (const mark of document.querySelectorAll("[data-name]")) {
  mark.addEventListener("mouseenter", () => {
    for (const one of document.querySelectorAll(".hit")) one.classList.remove("hit");
    const name = CSS.escape(mark.dataset.name);
    for (const one of document.querySelectorAll(`[data-name="${name}"]`)) {
      one.classList.add("hit");
      const row = one.closest("tr");
      if (row) row.classList.add("hit");
    }
    if (mark.dataset.told) told.textContent = mark.dataset.told;
  });
}
"""
"""Shows a result's figures, and itself in every drawing and the table, where it is pointed at."""


def legend(families: Sequence[str]) -> str:
    """Which shape and colour is whose."""
    entries = "".join(
        f'<span><svg viewBox="-7 -7 14 14" class="family{at}">{_mark(at, 0, 0, "mark")}</svg>'
        f"{escape(name)}</span>"
        for at, name in enumerate(families)
    )
    return f'<div class="legend">{entries}</div>'


def told(result: Mapping[str, Any]) -> str:
    """A result's figures in one line."""
    parameters = ", ".join(f"{key} {value}" for key, value in result["parameters"].items())
    figures = [
        f"{result['name']} ({parameters})",
        "read off a larger fit" if result.get("read_off") else "fitted",
        *(f"{title} {_text(key)(result.get(key))}" for key, title in COSTS.items()),
        *(f"{title} {_text(key)(error_of(result, key))}" for key, title in ERRORS.items()),
    ]
    return "; ".join(figures)


def _text(key: str) -> Callable[[Number], str]:
    if key.endswith("bytes"):
        return bytes_text
    if key.endswith("seconds"):
        return seconds_text
    return percent_text if key == "mean_radiance_error" else error_text


def plot(results: Sequence[Mapping[str, Any]], cost: str, error: str) -> str:
    """One error against one cost.

    Args:
        results: Of a report.
        cost: A key of :data:`prt_torch.tradeoff.COSTS`.
        error: A key of :data:`prt_torch.tradeoff.ERRORS`.

    Returns:
        An SVG element; a note where no result has both.
    """
    families = list(dict.fromkeys(str(one["representation"]) for one in results))
    shown = {
        str(one["name"]): (one, float(one[cost]), lost)
        for one in results
        if one.get(cost) and (lost := error_of(one, error))
    }
    title = f"{ERRORS[error]} against {COSTS[cost]}"
    if not shown:
        return f'<p class="note">{escape(title)}: no result has both.</p>'
    binary = cost.endswith("bytes")
    across = _Axis([x for _, x, _ in shown.values()], _LEFT, _WIDTH - _RIGHT, binary=binary)
    along = _Axis([y for _, _, y in shown.values()], _HEIGHT - _BOTTOM, _TOP)
    places = {name: (across.at(x), along.at(y)) for name, (_, x, y) in shown.items()}
    parts = [f'<text class="title" x="{_LEFT}" y="18">{escape(title)}</text>']
    parts += [_tick(across.at(x), None, _text(cost)(x)) for x in across.ticks()]
    parts += [_tick(None, along.at(y), _text(error)(y)) for y in along.ticks()]
    drawn = [one for one, _, _ in shown.values()]
    for family, names in fronts(drawn, cost, error).items():
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in _steps([places[name] for name in names]))
        kind = "joint" if family == "joint" else f"front family{families.index(family)}"
        parts.append(f'<polyline class="{kind}" points="{line}"/>')
    for name, (one, _, _) in shown.items():
        at = families.index(str(one["representation"]))
        kind = f"mark family{at}{' read' if one.get('read_off') else ''}"
        line = escape(told(one), quote=True)
        data = f'data-name="{escape(name, quote=True)}" data-told="{line}"'
        parts.append(_mark(at, *places[name], kind, data, line))
    return f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img">{"".join(parts)}</svg>'


_ROUND = (
    (1,),
    (1, 3),
    (1, 2, 5),
    (1, 1.5, 2, 3, 4, 5, 6, 8),
    tuple(tenth / 10 for tenth in range(10, 100)),  # no axis is too short for three of these
)


class _Axis:
    """A logarithmic axis from a first to a last coordinate, with some room."""

    def __init__(self, values: Sequence[float], first: float, last: float, binary: bool = False):
        self.binary = binary
        low, high = math.log10(min(values)), math.log10(max(values))
        room = max(0.06 * (high - low), 0.06)
        self.low, self.high, self.first, self.last = low - room, high + room, first, last

    def at(self, value: float) -> float:
        """Coordinate of a value."""
        share = (math.log10(value) - self.low) / (self.high - self.low)
        return self.first + share * (self.last - self.first)

    def ticks(self) -> list[float]:
        """A few round values: powers of two, or of ten with 2 and 5 between where these are few."""
        if self.binary:
            powers = range(math.ceil(self.low / _LOG2), math.floor(self.high / _LOG2) + 1)
            return [2.0**power for power in powers][:: math.ceil(len(powers) / 7) or 1]
        decades = range(math.floor(self.low), math.ceil(self.high) + 1)
        inside: list[float] = []
        for steps in _ROUND:
            every = [step * 10.0**decade for decade in decades for step in steps]
            inside = [one for one in every if self.low <= math.log10(one) <= self.high]
            if len(inside) >= 3:
                break
        return inside[:: math.ceil(len(inside) / 7)]


def _tick(x: float | None, y: float | None, text: str) -> str:
    if y is None:
        return (
            f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{_TOP}" y2="{_HEIGHT - _BOTTOM}"/>'
            f'<text x="{x:.1f}" y="{_HEIGHT - _BOTTOM + 18}" text-anchor="middle">{text}</text>'
        )
    return (
        f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
        f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{text}</text>'
    )


def _steps(places: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """What a cost buys stays the same up to the next that is bought."""
    line = [places[0]]
    for before, after in itertools.pairwise(places):
        line += [(after[0], before[1]), after]
    return line


def _mark(family: int, x: float, y: float, kind: str, data: str = "", title: str = "") -> str:
    inside = f"<title>{title}</title>" if title else ""
    given = f'class="{kind}" {data}'.strip()
    outlines = {
        "square": "-4,-4 4,-4 4,4 -4,4",
        "up": "0,-5 5,4 -5,4",
        "diamond": "0,-5.5 5.5,0 0,5.5 -5.5,0",
        "down": "0,5 5,-4 -5,-4",
        "cross": "-2,-5 2,-5 2,-2 5,-2 5,2 2,2 2,5 -2,5 -2,2 -5,2 -5,-2 -2,-2",
        "star": "0,-6 1.8,-1.8 6,0 1.8,1.8 0,6 -1.8,1.8 -6,0 -1.8,-1.8",
    }
    shape = SHAPES[family % len(SHAPES)]
    if shape == "circle":
        return f'<circle {given} cx="{x:.1f}" cy="{y:.1f}" r="4.4">{inside}</circle>'
    at = f'transform="translate({x:.1f} {y:.1f})"'
    return f'<polygon {given} {at} points="{outlines[shape]}">{inside}</polygon>'


def bars(stages: Sequence[Stage]) -> str:
    """A waterfall: signed differences one after the other, their total, and each stage alone."""
    reach = [0.0, *(one.error for one in stages)]
    most = max([*reach, *(one.alone or 0.0 for one in stages)]) or 1.0
    half = (_BARS_WIDTH - 40) / 2

    def across(value: float) -> float:
        return _BARS_LEFT + half * value / most

    parts = [
        f'<text class="title" x="{_BARS_LEFT}" y="16">one after the other</text>',
        f'<text class="title" x="{_BARS_LEFT + half + 130}" y="16">alone</text>',
    ]
    for at, (stage, before) in enumerate(zip(stages, reach, strict=False)):
        y = 26 + at * (_BAR + _GAP)
        low, high = sorted((across(before), across(stage.error)))
        kind = "more" if stage.difference >= 0 else "less"
        parts += [
            f'<text x="{_BARS_LEFT - 10}" y="{y + 17}" text-anchor="end">'
            f"{escape(stage.name)}</text>",
            f'<rect class="{kind}" x="{low:.1f}" y="{y}" width="{max(high - low, 1):.1f}" '
            f'height="{_BAR}"><title>{stage.name}: {stage.difference:+.3e}</title></rect>',
            f'<text x="{max(high, low + 1) + 6:.1f}" y="{y + 17}">{stage.difference:+.2e}</text>',
        ]
        if stage.alone is not None:
            x, width = _BARS_LEFT + half + 130, 0.6 * half * stage.alone / most
            parts += [
                f'<rect class="alone" x="{x}" y="{y}" width="{max(width, 1):.1f}" '
                f'height="{_BAR}"><title>{stage.name} alone: {stage.alone:.3e}</title></rect>',
                f'<text x="{x + max(width, 1) + 6:.1f}" y="{y + 17}">{stage.alone:.2e}</text>',
            ]
    y, total = 26 + len(stages) * (_BAR + _GAP), stages[-1].error
    parts += [
        f'<text class="title" x="{_BARS_LEFT - 10}" y="{y + 17}" text-anchor="end">total</text>',
        f'<rect class="total" x="{_BARS_LEFT}" y="{y}" '
        f'width="{max(across(total) - _BARS_LEFT, 1):.1f}" height="{_BAR}"/>',
        f'<text x="{across(total) + 6:.1f}" y="{y + 17}">{total:.2e}</text>',
    ]
    width = _BARS_LEFT + half + 130 + 0.6 * half + 90
    return f'<svg viewBox="0 0 {width:.0f} {y + _BAR + 10}" role="img">{"".join(parts)}</svg>'
