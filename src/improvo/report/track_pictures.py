"""Pictures of one frame with its tracks (paper, Figure "Labeling points with VO", rows a, c and d)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from improvo.errors import ConfigError
from improvo.odometry.run.run_folder import RunFolder
from improvo.report.canvas import Canvas
from improvo.report.palettes import PALETTES, Palette
from improvo.stability.rule import IGNORE, STABLE, UNSTABLE
from improvo.types import Float32, Int64, UInt8

_JUMP_SHARE = 0.03  # share of the image width; shorter links never count as a jump

FramePainter = Callable[[RunFolder, int], UInt8]  # (run, frame) -> RGB picture


@dataclass(frozen=True)
class TrackPictureSettings:
    """How tracks are drawn."""

    tail: int = 8  # frames of flow behind each point
    min_age: int = 3  # frames; younger tracks, half of them wrong matches, are drawn as dots
    old: int = 30  # frames; tracks of this age and more have the last colour
    large_error: float = 3.0  # pixels; residuals of this size and more have the last colour
    palette: Palette = PALETTES["paper"]
    width: int = 1280  # small frames are enlarged to about this

    def __post_init__(self) -> None:
        if min(self.tail, self.min_age) < 0 or min(self.old, self.width) < 1 or not self.large_error > 0:
            raise ConfigError("track pictures: tail and min_age must be 0 or more, old, width and large_error positive")


def paint_tracks(run: RunFolder, frame: int, settings: TrackPictureSettings | None = None) -> UInt8:
    """Sparse flow: where each track came from in the last frames, coloured by its age (row a)."""
    settings = settings or TrackPictureSettings()
    canvas = Canvas(run.image(frame), width=settings.width)
    seen = run.observations(frame)
    colours = settings.palette.ramp_colours(seen.age, 1, settings.old)
    rows = np.argsort(seen.age, kind="stable")  # old tracks on top
    young, grown = rows[seen.age[rows] < settings.min_age], rows[seen.age[rows] >= settings.min_age]
    canvas.dots(seen.keypoints[young], colours[young], 0.9)
    _draw_tails(canvas, run, frame, settings.tail, seen.track[grown], colours[grown])
    canvas.dots(seen.keypoints[grown], colours[grown], 1.7)
    median = np.median(seen.age[grown]) if len(grown) else 0
    return canvas.with_caption(
        f"frame {frame}: {len(grown)} tracks of {settings.min_age}+ frames, {len(young)} younger (dots); "
        f"median age {median:.0f}",
        (settings.palette.ramp_strip(), "new", f"{settings.old}+ frames"),
    )


def paint_residuals(run: RunFolder, frame: int, settings: TrackPictureSettings | None = None) -> UInt8:
    """Re-projection errors under the final poses, blue low to red high (row c); points without one are left out."""
    settings = settings or TrackPictureSettings()
    canvas = Canvas(run.image(frame), width=settings.width)
    seen = run.observations(frame)
    rows = np.flatnonzero(np.isfinite(seen.error))
    rows = rows[np.argsort(seen.error[rows], kind="stable")]  # large errors on top
    canvas.dots(seen.keypoints[rows], settings.palette.ramp_colours(seen.error[rows], 0, settings.large_error), 2.2)
    error = seen.error[rows]
    over = f"{(error > settings.large_error).mean():.0%} over {settings.large_error:g} px" if len(rows) else ""
    middle = f"; median {np.median(error):.2f} px, {over}" if len(rows) else ""
    return canvas.with_caption(
        f"frame {frame}: re-projection error of {len(rows)} points{middle}",
        (settings.palette.ramp_strip(), "0", f"{settings.large_error:g}+ px"),
    )


def paint_labels(run: RunFolder, frame: int, settings: TrackPictureSettings | None = None) -> UInt8:
    """Stability labels: green stable, red unstable, blue ignored (row d), with each track's flow."""
    settings = settings or TrackPictureSettings()
    canvas = Canvas(run.image(frame), width=settings.width)
    seen = run.observations(frame)
    colours = settings.palette.label_colours(seen.stability)
    for code, radius in ((IGNORE, 1.2), (STABLE, 2.0), (UNSTABLE, 2.6)):  # what matters most on top
        rows = np.flatnonzero(seen.stability == code)
        if code != IGNORE:
            _draw_tails(canvas, run, frame, settings.tail, seen.track[rows], colours[rows])
        canvas.dots(seen.keypoints[rows], colours[rows], radius)
    counts = np.bincount(seen.stability, minlength=3)
    words = {"paper": ("green", "red", "blue"), "colour-blind": ("green", "orange", "blue")}[settings.palette.name]
    return canvas.with_caption(
        f"frame {frame}: {counts[STABLE]} stable ({words[0]}), {counts[UNSTABLE]} unstable ({words[1]}), "
        f"{counts[IGNORE]} ignored ({words[2]})"
    )


def _draw_tails(canvas: Canvas, run: RunFolder, frame: int, tail: int, tracks: Int64, colours: UInt8) -> None:
    """The flow of the given tracks through the last `tail` frames; links that jump are drawn faintly.

    Raw tracks contain wrong matches. Drawn at full strength, their long lines would hide everything else.
    """
    links: list[tuple[Float32, Float32, UInt8]] = []
    keypoints = run.tracks.keypoints
    later = run.rows_of(frame, tracks)
    for before in range(frame - 1, max(frame - tail, 0) - 1, -1):
        earlier = run.rows_of(before, tracks)
        both = (later >= 0) & (earlier >= 0)
        if not both.any():
            break
        links.append((keypoints[earlier[both]], keypoints[later[both]], colours[both]))
        later = earlier
    if not links:
        return
    start, end, colour = (np.concatenate(parts) for parts in zip(*links, strict=True))
    length = np.linalg.norm(end - start, axis=1)
    jumps = length > max(4.0 * float(np.median(length)), _JUMP_SHARE * run.camera.width)
    canvas.segments(start[jumps], end[jumps], colour[jumps], opacity=0.25)
    canvas.segments(start[~jumps], end[~jumps], colour[~jumps], thickness=max(1, canvas.scale - 1))
