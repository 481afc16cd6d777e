"""Error against storage and against run time: every result a named point, on log axes.

The uncompressed tensor is among them. Where its error is 0, it and every lossless result lie on a
dashed line at the bottom, which stands for the zero that a log axis does not have. Errors that
rounding explains lie there too.
"""

import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from prt_torch.report.labels import place_labels
from prt_torch.report.numbers import bytes_text, error_text, percent_text, seconds_text
from prt_torch.report.outcome import (
    Number,
    Outcome,
    outcomes,
    runs,
    uncompressed_reference_error,
)

_UNCOMPRESSED = "uncompressed"
_ROUNDING = 1e-15  # squared errors below come from float32 storage alone, and are drawn as 0


@dataclass(frozen=True)
class Palette:
    """Colours of a plot, chosen to tell families apart with deficient colour vision too."""

    surface: str
    ink: str
    muted: str
    grid: str
    families: tuple[str, ...]


LIGHT = Palette(
    surface="#ffffff",
    ink="#1f2328",
    muted="#6b7280",
    grid="#e6e8eb",
    families=("#2a78d6", "#eb6834", "#1baf7a", "#4a3aa7", "#d99500", "#d6568c", "#3f8f00"),
)
DARK = Palette(
    surface="#181b20",
    ink="#e6e8eb",
    muted="#9aa1ab",
    grid="#2c3138",
    families=("#5b9bea", "#f08a5d", "#2cc48d", "#9a8cf0", "#e0ad3a", "#ea84ae", "#7cc142"),
)
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")


_Text = Callable[[Number], str]


@dataclass(frozen=True)
class _Point:
    """A result in one panel; an ``error`` of None is a vertical line, for it is not known."""

    name: str
    family: str
    cost: float
    error: Number


@dataclass(frozen=True)
class _Panel:
    """One vertical axis: its title, the error of a result and its text, and what counts as 0."""

    title: str
    error: Callable[[Outcome], Number]
    text: _Text
    rounding: float
    uncompressed: list[_Point]


def error_against_bytes(report: Mapping[str, Any], *, palette: Palette = LIGHT) -> bytes:
    """A PNG of error against storage.

    The left panel has the squared error of the transfer: in the tensor's own basis for one run,
    against the bake at full resolution for several. The right one, if there is any, has the
    relative error of radiance, averaged over environments.

    Args:
        report: A run dictionary, or several gathered.
        palette: :data:`LIGHT` or :data:`DARK`.
    """
    return _plot(report, palette, "storage", lambda row: row.bytes, bytes_text, base=2)


def error_against_time(report: Mapping[str, Any], *, palette: Palette = LIGHT) -> bytes:
    """A PNG of error against the time of one relighting; see :func:`error_against_bytes`."""
    cost = "time of one relighting"
    return _plot(report, palette, cost, lambda row: row.relight_seconds, seconds_text, base=10)


def _plot(
    report: Mapping[str, Any],
    palette: Palette,
    cost_label: str,
    cost: Callable[[Outcome], Number],
    cost_text: _Text,
    base: int,
) -> bytes:
    rows = outcomes(report)
    panels = _panels(report, rows, storage=base == 2)
    families = list(dict.fromkeys(row.representation for row in rows))
    width = 6.6 * len(panels)
    figure = Figure(figsize=(width, 5.0), dpi=110, facecolor=palette.surface)
    FigureCanvasAgg(figure)
    # Fixed margins: labels are placed in pixels, so nothing may move the axes afterwards.
    figure.subplots_adjust(
        left=0.8 / width, right=1 - 0.15 / width, bottom=0.2, top=0.93, wspace=0.17
    )
    for index, panel in enumerate(panels):
        axes = figure.add_subplot(1, len(panels), index + 1)
        points = [
            _Point(row.name, row.representation, float(x), y if y > panel.rounding else 0.0)
            for row in rows
            if (x := cost(row)) and x > 0 and (y := panel.error(row)) is not None and y >= 0
        ]
        missing = len(rows) - len(points)
        suffix = f"   ({missing} of {len(rows)} without a value)" if missing else ""
        axes.set_title(panel.title, loc="left", fontsize=9.5, color=palette.ink)
        axes.set_xlabel(cost_label + suffix, color=palette.muted)
        texts = (cost_text, panel.text)
        _draw_panel(axes, points, panel.uncompressed, families, palette, texts, base)
    return _encode(figure, families, palette)


def _panels(report: Mapping[str, Any], rows: Sequence[Outcome], *, storage: bool) -> list[_Panel]:
    """What the vertical axes show: errors of transfer, and of radiance if there are any."""
    joint = len(runs(report)) > 1
    limits = _uncompressed(report, rows, joint, storage)
    title = "squared transfer error / squared norm"
    if joint:
        title += ", against full resolution"
        panels = [_Panel(title, lambda row: row.reference_error, error_text, _ROUNDING, limits)]
    else:
        panels = [_Panel(title, lambda row: row.transfer_error, error_text, _ROUNDING, limits)]
    if any(row.radiance_error for row in rows):
        # What a basis cut off shows in radiance too, by an amount that no report holds.
        unknown = [replace(limit, error=None if joint else limit.error) for limit in limits]
        title, rounding = "relative radiance error, mean over environments", math.sqrt(_ROUNDING)
        panels.append(
            _Panel(title, lambda row: row.mean_radiance_error, percent_text, rounding, unknown)
        )
    return panels


def _uncompressed(
    report: Mapping[str, Any], rows: Sequence[Outcome], joint: bool, storage: bool
) -> list[_Point]:
    """The uncompressed tensor of every run; equal ones once."""
    points: dict[tuple[float, Number], _Point] = {}
    for run in runs(report):
        own = [row for row in rows if row.run == run.name]
        times = [row.dense_seconds for row in own if row.dense_seconds]
        cost = run.raw_bytes if storage else (sorted(times)[len(times) // 2] if times else None)
        error = uncompressed_reference_error(own) if joint else 0.0
        if cost:
            name = f"{run.name}: {_UNCOMPRESSED}"
            points.setdefault((cost, error), _Point(name, "", float(cost), error))
    if len(points) == 1:
        return [replace(point, name=_UNCOMPRESSED) for point in points.values()]
    return list(points.values())


def _draw_panel(
    axes: Axes,
    points: Sequence[_Point],
    uncompressed: Sequence[_Point],
    families: Sequence[str],
    palette: Palette,
    texts: tuple[_Text, _Text],
    base: int,
) -> None:
    _style(axes, palette)
    everything = [*points, *uncompressed]
    errors = [point.error for point in everything if point.error is not None]
    if not everything:
        axes.text(0.5, 0.5, "no values", transform=axes.transAxes, ha="center", color=palette.muted)
        axes.set(xticks=[], yticks=[])
        return
    floor = _zero_line(axes, errors, palette)
    _set_scales(axes, [point.cost for point in everything], errors, floor, texts, base)
    _draw_front(axes, points, floor, palette)
    anchors: list[tuple[float, float, str]] = []
    for point in everything:
        if point.error is None:
            axes.axvline(point.cost, color=palette.muted, linewidth=1, linestyle=":")
            anchors.append((point.cost, math.sqrt(math.prod(axes.get_ylim())), point.name))
            continue
        height = point.error or floor
        if point.family or point in points:
            index = families.index(point.family)
            colour = palette.families[index % len(palette.families)]
            style = {"marker": _MARKERS[index % len(_MARKERS)], "markersize": 7.5, "color": colour}
        else:
            style = {"marker": "*", "markersize": 13, "color": palette.ink}
        axes.plot(
            [point.cost], [height], linestyle="", markeredgecolor=palette.surface, zorder=3, **style
        )
        anchors.append((point.cost, height, point.name))
    place_labels(axes, anchors, ink=palette.ink, halo=palette.surface, leader=palette.muted)


def _style(axes: Axes, palette: Palette) -> None:
    axes.set_facecolor(palette.surface)
    axes.grid(True, color=palette.grid, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=palette.muted, labelsize=8.5, length=0)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(palette.grid)


def _zero_line(axes: Axes, errors: Sequence[float], palette: Palette) -> float:
    """Where an error of 0 is drawn: below all others; a dashed line marks it if it is used."""
    positive = [error for error in errors if error > 0]
    if not positive:
        floor = 1e-8
    else:
        # A sixth of the span below the smallest keeps the line clear of what is nearly zero.
        span = math.log10(max(positive) / min(positive))
        floor = min(positive) / 10 ** max(0.5, 0.16 * span)
    if len(positive) < len(errors):
        axes.axhline(floor, color=palette.muted, linewidth=0.9, linestyle=(0, (4, 3)), zorder=1)
    return floor


def _set_scales(
    axes: Axes,
    costs: Sequence[float],
    errors: Sequence[float],
    floor: float,
    texts: tuple[_Text, _Text],
    base: int,
) -> None:
    cost_text, error_format = texts
    has_zero = any(error == 0 for error in errors)
    heights = [error for error in errors if error > 0] + ([floor] if has_zero else [])
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(*_padded(costs, 0.12))
    axes.set_ylim(*_padded(heights or [floor], 0.1))
    low, high = axes.get_ylim()
    nearest = floor * (high / low) ** 0.05  # what lies below would touch the tick of zero
    ticks = [tick for tick in _log_ticks(low, high, 10) if not has_zero or tick > nearest]
    axes.yaxis.set_major_locator(FixedLocator([floor, *ticks] if has_zero else ticks))
    axes.yaxis.set_major_formatter(
        FuncFormatter(
            lambda value, _: "0" if has_zero and value == floor else _rounded(error_format(value))
        )
    )
    axes.xaxis.set_major_locator(FixedLocator(_log_ticks(*axes.get_xlim(), base)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _rounded(cost_text(value))))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_minor_locator(NullLocator())


def _rounded(text: str) -> str:
    """A number's text without the zeros that end its decimals; ticks are round values."""
    return re.sub(r"(\.\d*?)0+(?!\d)", r"\1", text).replace(". ", " ").replace(".e", "e")


def _padded(values: Sequence[float], share: float) -> tuple[float, float]:
    """Log-axis limits round positive values, with room for markers and labels."""
    low, high = math.log10(min(values)), math.log10(max(values))
    room = max(share * (high - low), 0.02) if high > low else 0.3
    return 10 ** (low - room), 10 ** (high + room)


def _log_ticks(low: float, high: float, base: int) -> list[float]:
    """A few round values inside the limits: powers, with 1, 2, 5 of ten or even steps if few."""
    first, last = math.floor(math.log(low, base)), math.ceil(math.log(high, base))
    stride = max(1, math.ceil((last - first) / 8))
    powers = range(first - first % stride, last + 1, stride)
    steps = (1.0, 2.0, 5.0) if base == 10 and last - first <= 3 else (1.0,)
    ticks = [step * float(base) ** power for power in powers for step in steps]
    inside = [tick for tick in ticks if low <= tick <= high]
    if len(inside) < 3:
        even = MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(low, high)
        inside = [float(tick) for tick in even if low <= tick <= high]
    return inside


def _draw_front(axes: Axes, points: Sequence[_Point], floor: float, palette: Palette) -> None:
    """A step line through the results that no other beats in cost and error at once."""
    front: list[tuple[float, float]] = []
    ordered = sorted((point.cost, point.error) for point in points if point.error is not None)
    for cost, error in ordered:
        if not front or error < front[-1][1]:
            front.append((cost, error))
    if len(front) > 1:
        costs, errors = zip(*((cost, error or floor) for cost, error in front), strict=True)
        axes.step(costs, errors, where="post", color=palette.muted, linewidth=1.2, zorder=2)


def _encode(figure: Figure, families: Sequence[str], palette: Palette) -> bytes:
    handles = [
        figure.axes[0].plot(
            [], [], linestyle="", marker=_MARKERS[index % len(_MARKERS)], markersize=7,
            color=palette.families[index % len(palette.families)], label=family,
        )[0]
        for index, family in enumerate(families)
        if family
    ]  # fmt: skip
    handles += figure.axes[0].plot([], [], color=palette.muted, label="beaten by no other result")
    figure.legend(
        handles=handles,
        loc="lower center",
        ncols=min(len(handles), 4 * len(figure.axes)),
        frameon=False,
        fontsize=8.5,
        labelcolor=palette.ink,
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", facecolor=palette.surface, metadata={"Software": None})
    return buffer.getvalue()
