"""The overhead projection of trajectory and map (paper, Figure "Labeling points with VO", row b)."""

from __future__ import annotations

import io
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from improvo.errors import InputError, require_plots
from improvo.files import written_atomically
from improvo.odometry.run.run_folder import RunFolder
from improvo.report.overhead import overhead_axes, robust_limits
from improvo.report.palettes import PALETTES, Palette
from improvo.report.true_path import TruePath, true_path
from improvo.types import Float64, Int64, SparseMap, UInt8

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BACKGROUND = "#565b63"  # neither the paper's black (last window) nor its white (points)
_DOUBTED = "#ff4fd8"  # a band under the path, which no ramp of the palettes has
LAST_POSES = 30  # N_last
_NARROW, _NARROW_LINE = 3.8, 60  # inches, and letters of the title in a line, on a telephone
_DARKEST = 70  # grey level in which black points are drawn


def draw_map(run: RunFolder, path: Path, palette: Palette = PALETTES["paper"], last_poses: int = LAST_POSES) -> None:
    """Write the picture as PNG, see `map_png`.

    Raises:
        InputError: no frame of the run has a pose.
        OutputError: the file cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    picture = map_png(run, palette, last_poses)
    with written_atomically(path) as temporary:
        temporary.write_bytes(picture)


def map_png(
    run: RunFolder, palette: Palette = PALETTES["paper"], last_poses: int = LAST_POSES, narrow: bool = False
) -> bytes:
    """A PNG: points in their own colours, the trajectory from blue to red over time, the last window black.

    Args:
        run: the finished run.
        palette: of the trajectory.
        last_poses: that are drawn black.
        narrow: for a telephone: as wide as its screen in inches, so that letters have the size that they are given.

    Raises:
        InputError: no frame of the run has a pose.
        MissingExtraError: matplotlib is not installed.
    """
    require_plots("a map seen from above")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if len(run.trajectory) == 0:
        raise InputError(f"{run.path}: no frame has a pose, so there is no map to draw; see `events` in run.json")
    above = overhead_axes(run.trajectory.world_from_cam)
    first = run.trajectory.camera_centers[0]  # where the axes begin
    path = above.project(run.trajectory.camera_centers - first)
    points = above.project(run.map.xyz[trusted_points(run.map)] - first)
    low, high = robust_limits(path, points)
    width, height = _figure_size(high - low)
    if narrow:
        width, height = _NARROW, height * _NARROW / width + 0.6
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    axis.set_facecolor(_BACKGROUND)
    inside: NDArray[np.bool_] = np.all((points > low) & (points < high), axis=1)
    _draw_points(axis, run, points, inside, narrow)
    _draw_path(axis, run, path, palette, last_poses)
    truth = true_path(run)
    if truth is not None:
        is_below = float(np.median(path[:, 1])) < (low[1] + high[1]) / 2  # where the path is, the legend is not
        _draw_truth(axis, run.trajectory.segment, above.project(truth.drawn() - first), is_below)

    axis.set_xlim(low[0], high[0])
    axis.set_ylim(low[1], high[1])
    axis.set_aspect("equal")
    axis.grid(color="white", alpha=0.12, linewidth=0.6)
    axis.tick_params(labelsize=8)
    unit = "metres" if run.unit.startswith("metres") else "map units: the first median depth is 1"
    axis.set_xlabel(f"right of the first camera ({unit})", fontsize=8)
    axis.set_ylabel("ahead of the first camera", fontsize=8)
    title = _title(run, len(points), int((~inside).sum()), truth)
    if narrow:
        title = "\n".join(textwrap.fill(line, _NARROW_LINE) for line in title.splitlines())
    axis.set_title(title, fontsize=8 if narrow else 10)  # above the axis, however much of the figure that fills
    _time_bar(figure, axis, palette, run.frames, min(last_poses, len(path)))
    png = io.BytesIO()
    figure.savefig(png, dpi=220 if narrow else 150, format="png", bbox_inches="tight", metadata={"Software": None})
    return png.getvalue()


def _draw_points(axis: Axes, run: RunFolder, points: Float64, inside: NDArray[np.bool_], narrow: bool) -> None:
    """The trusted points of the map, (n, 2) seen from above, in their own colours; those inside of the picture."""
    size, alpha = _point_style(int(inside.sum()))
    axis.scatter(
        points[inside, 0],
        points[inside, 1],
        s=size * (0.4 if narrow else 1.0),
        c=map_colours(run.map)[trusted_points(run.map)][inside] / 255.0,
        alpha=alpha,
        linewidths=0,
        zorder=1,
        rasterized=True,
    )


def _draw_path(axis: Axes, run: RunFolder, path: Float64, palette: Palette, last_poses: int) -> None:
    """The trajectory, (n, 2) seen from above: coloured by time, broken between segments, marked where it is doubted."""
    from matplotlib.collections import LineCollection

    segment = run.trajectory.segment
    links = np.stack([path[:-1], path[1:]], axis=1)
    joined = segment[:-1] == segment[1:]
    doubted = (run.doubtful | run.uncertain)[1:] & joined
    colours = palette.ramp_colours(run.frame_indices.astype(float), 0, max(run.frames - 1, 1)) / 255.0
    looks: tuple[tuple[NDArray[np.bool_], dict[str, Any]], ...] = (
        (joined, {"colors": colours[1:][joined], "linewidths": 3.0, "capstyle": "round", "zorder": 3}),
        (~joined, {"colors": "white", "linewidths": 1.0, "linestyles": "dotted", "zorder": 2}),
        (doubted, {"colors": _DOUBTED, "linewidths": 8.0, "capstyle": "round", "alpha": 0.8, "zorder": 2}),
    )
    for which, look in looks:
        axis.add_collection(LineCollection(list(links[which]), **look))
    last = path[-last_poses:]
    for number in np.unique(segment[-last_poses:]):  # no black line leads from one to the next
        here = last[segment[-last_poses:] == number]
        axis.plot(*here.T, color="white", linewidth=5.5, solid_capstyle="round", zorder=4)
        axis.plot(*here.T, color="black", linewidth=3.5, solid_capstyle="round", zorder=5)
    axis.plot(*path[0], "o", color=tuple(colours[0]), markeredgecolor="white", markersize=8, zorder=6)
    axis.annotate("start", path[0], (6, 6), textcoords="offset points", color="white", fontsize=9, zorder=7)
    for number in np.unique(segment)[1:]:
        start = path[np.flatnonzero(segment == number)[0]]
        axis.annotate(
            f"segment {number}", start, (6, -12), textcoords="offset points", color="white", fontsize=8, zorder=7
        )


def _draw_truth(axis: Axes, segment: Int64, truth: Float64, is_below: bool) -> None:
    """The true path, (n, 2) seen from above; the legend is at the top where the path is below."""
    for number in np.unique(segment):
        axis.plot(
            *np.where((segment == number)[:, None], truth, np.nan).T,
            color="#7fffd4",
            linewidth=1.3,
            linestyle=(0, (4, 2)),
            zorder=8,
            label="true path, aligned" if number == segment[0] else None,
        )
    axis.legend(
        loc="upper left" if is_below else "lower left",
        fontsize=8,
        facecolor=_BACKGROUND,
        labelcolor="white",
        framealpha=0.8,
    )


def trusted_points(sparse_map: SparseMap) -> NDArray[np.intp]:
    """Rows of the good points: at least three observations, and a mean error below 2 pixels."""
    good = (sparse_map.observations >= 3) & (sparse_map.mean_error < 2.0) & np.isfinite(sparse_map.xyz).all(axis=1)
    return np.flatnonzero(good)


def map_colours(sparse_map: SparseMap) -> UInt8:
    """RGB (P, 3) of the points as the recording shows them, not so dark that they are lost; white where not known."""
    if sparse_map.rgb is None:
        return np.full((len(sparse_map), 3), 235, np.uint8)
    return np.rint(_DARKEST + (255 - _DARKEST) / 255.0 * sparse_map.rgb).astype(np.uint8)


def _title(run: RunFolder, points: int, outside: int, truth: TruePath | None) -> str:
    frames, segments = run.report["frames"], run.report["segments"]
    parts = [
        f"{frames['tracked']} of {frames['processed']} frames have a pose",
        f"{points} good points of {len(run.map)}",
    ]
    if outside:
        parts.append(f"{outside} far ones outside the picture")
    if truth is not None:
        parts.append(f"{truth.text} off the true one")
    if (run.doubtful | run.uncertain).any():
        parts.append("doubtful where the band is pink")
    if len(segments) > 1:
        own = "" if run.unit.startswith("metres") else "each with its own scale, "
        parts.append(f"{len(segments)} segments, {own}placed by guess")
    return f"{run.name}, {Path(run.report['frontend']).name}, seen from above\n" + "; ".join(parts)


def _figure_size(extent: NDArray[np.float64]) -> tuple[float, float]:
    """Inches, near the shape of what is drawn."""
    shape = float(np.clip(extent[0] / extent[1], 0.4, 2.6))
    return (8.6, 8.6 / shape + 1.7) if shape >= 1 else (7.0 * shape + 2.8, 7.0 + 1.2)


def _point_style(count: int) -> tuple[float, float]:
    """Area and opacity of a point, so that many still show structure."""
    return float(np.clip(20_000 / max(count, 1), 1.2, 8.0)), float(np.clip(8_000 / max(count, 1), 0.35, 0.9))


def _time_bar(figure: Figure, axis: Axes, palette: Palette, frames: int, last: int) -> None:
    """The colour bar."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    colours = ListedColormap(list(palette.ramp_table() / 255.0))
    scale = ScalarMappable(Normalize(0, max(frames - 1, 1)), colours)
    bar = figure.colorbar(scale, ax=axis, fraction=0.035, pad=0.02)
    bar.set_label(f"frame (black: the last {last})", fontsize=8)
    bar.ax.tick_params(labelsize=8)
