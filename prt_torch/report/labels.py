"""Names beside the points of a plot, moved until they cover neither each other nor a point."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.patheffects import withStroke

_LONGEST = 30
_MARKER_RADIUS = 7.0  # pixels kept clear round a point
_RADII = (9.0, 15.0, 24.0, 36.0, 52.0, 72.0, 96.0, 124.0)
_ANGLES = (0, 180, 90, 270, 30, 330, 150, 210, 60, 300, 120, 240)
_LEADER_FROM = 16.0
_OUTSIDE_PENALTY = 4.0  # a name that leaves the plot is worse than one that covers another


def place_labels(
    axes: Axes, anchors: Sequence[tuple[float, float, str]], *, ink: str, halo: str, leader: str
) -> None:
    """Write each name near its point, with a thin leader where it had to move away.

    Places are tried from near to far, those in the thick of things last; the first that is free
    is taken, or else the one that covers least.

    Args:
        axes: With limits and scales set.
        anchors: Data coordinates of points, and their names.
        ink: Colour of the text.
        halo: Colour of its outline, that of the surface.
        leader: Colour of leaders.
    """
    canvas = axes.figure.canvas
    if not anchors or not isinstance(canvas, FigureCanvasAgg):
        return
    renderer = canvas.get_renderer()
    frame = np.asarray(axes.get_window_extent(renderer).extents, np.float64)
    centres = axes.transData.transform([(x, y) for x, y, _ in anchors])
    taken = _boxes(centres, _MARKER_RADIUS)
    for index in np.lexsort((centres[:, 1], centres[:, 0])):
        x, y, name = anchors[index]
        text = axes.annotate(
            _shortened(name),
            (x, y),
            xytext=(0, 0),
            textcoords="offset pixels",
            ha="center",
            va="center",
            fontsize=8.5,
            color=ink,
            zorder=4,
            parse_math=False,
            path_effects=[withStroke(linewidth=2.5, foreground=halo)],
        )
        extent = text.get_window_extent(renderer)
        half_size = np.array([extent.width, extent.height]) / 2
        shift, box = _best_place(centres[index], half_size, taken, frame)
        text.set_position((float(shift[0]), float(shift[1])))
        taken = np.concatenate([taken, box[None]])
        nearest = np.copysign((np.abs(shift) - half_size).clip(min=0.0), shift)
        if np.linalg.norm(nearest) > _LEADER_FROM:
            axes.annotate(
                "",
                (x, y),
                xytext=(nearest[0], nearest[1]),
                textcoords="offset pixels",
                arrowprops={"arrowstyle": "-", "color": leader, "linewidth": 0.6},
                zorder=2,
            )


def _best_place(
    centre: Float64[np.ndarray, "2"],
    half_size: Float64[np.ndarray, "2"],
    taken: Float64[np.ndarray, "boxes 4"],
    frame: Float64[np.ndarray, "4"],
) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "4"]]:
    """Offset and box of the first free place round a point, or of the one that covers least."""
    radii, angles = np.meshgrid(_RADII, np.radians(_ANGLES), indexing="ij")
    around = np.stack([np.cos(angles), np.sin(angles)], axis=-1).reshape(-1, 2)
    shifts = around * (radii.reshape(-1, 1) + half_size)
    boxes = _boxes(centre + shifts, half_size)
    covered = _overlaps(boxes[:, None], taken[None]).sum(-1)
    outside = 4 * np.prod(half_size) - _overlaps(boxes, frame)
    cost = covered + _OUTSIDE_PENALTY * outside
    best = int(np.argmin(np.where(cost < 0.5, 0.0, cost)))
    return shifts[best], boxes[best]


def _boxes(
    centres: Float64[np.ndarray, "*batch 2"], half_size: Float64[np.ndarray, "2"] | float
) -> Float64[np.ndarray, "*batch 4"]:
    """Boxes as left, bottom, right, top, in pixels."""
    return np.concatenate([centres - half_size, centres + half_size], axis=-1)


def _overlaps(
    first: Float64[np.ndarray, "*#batch 4"], second: Float64[np.ndarray, "*#batch 4"]
) -> Float64[np.ndarray, "..."]:
    """Common areas of boxes, in square pixels."""
    sides = np.minimum(first[..., 2:], second[..., 2:]) - np.maximum(
        first[..., :2], second[..., :2]
    )
    return sides.clip(min=0.0).prod(-1)


def _shortened(name: str) -> str:
    """The name itself, or its head and tail if it is long."""
    return name if len(name) <= _LONGEST else f"{name[:18]}…{name[-11:]}"
