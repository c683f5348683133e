"""`report.html` of a run: what was run, what came out, and what to look out for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import PLOTS_MISSING, InputError, plots_installed
from improvo.odometry.run.run_folder import RunFolder
from improvo.odometry.verdict.told_verdicts import verdict_lines, verdict_of
from improvo.odometry.verdict.verdict import DOUBTFUL
from improvo.report.charts import line_chart
from improvo.report.map_picture import map_png, trusted_points
from improvo.report.page import Page, as_json, plain, swatch
from improvo.report.page_data import frames_data, per_frame, scene_data
from improvo.report.palettes import PALETTES, Palette
from improvo.report.plain_words import LABEL_WORDS, warnings
from improvo.report.true_path import TruePath, true_path
from improvo.stability.rule import IGNORE, STABLE, UNSTABLE

_MAX_FRAMES = 150  # of the slider
_FRAME_WIDTH = 480
_CODES = {"stable": STABLE, "unstable": UNSTABLE, "ignore": IGNORE}

_SCENE = """
<div class="controls only-screen">
<label><input type="radio" name="layer" value="map" checked> map points</label>
<label><input type="radio" name="layer" value="labels"> points by label</label>
<button type="button" id="scene-reset">Reset</button><button type="button" id="scene-above">From above</button>
<span class="legend">trajectory: first <i class="ramp" style="background:{gradient}"></i> last; black: last window;
pink: doubtful; yellow: the frame below{truth}</span><span class="legend" id="scene-labels" hidden>{labels}</span></div>
<canvas class="scene" id="scene" tabindex="0" aria-label="3D map: drag to turn, shift-drag to move, wheel to zoom">
</canvas>
<p class="note only-screen">Drag turns, shift or right button moves, the wheel zooms after a click on the map, two
fingers zoom and move; arrow keys and + - too. One finger up or down scrolls the page.</p>
<p class="note">{counts}</p>"""

_TRUTH = f"; {swatch('#7fffd4')}true path, each segment aligned"

_FRAMES = """
<div class="controls only-screen"><button type="button" id="frame-play">Play</button>
<input type="range" id="frame-slider" min="0" max="{last}" value="{middle}" aria-label="frame">
<label><input type="radio" name="overlay" value="tracks" checked> tracks</label>
<label><input type="radio" name="overlay" value="labels"> labels</label>
<label><input type="radio" name="overlay" value="residuals"> residuals</label>
<label><input type="radio" name="overlay" value="none"> none</label></div>
<figure><canvas id="frame" width="{width}" height="{height}"></canvas>
<figcaption><span id="frame-caption"></span><br>
<span class="legend" data-legend="tracks">age: new <i class="ramp" style="background:{gradient}"></i> 30 frames</span>
<span class="legend" data-legend="labels" hidden>{labels}</span>
<span class="legend" data-legend="residuals" hidden>re-projection error: 0
<i class="ramp" style="background:{gradient}"></i> 3 px</span></figcaption></figure>"""


def write_run_page(run: RunFolder, path: Path, palette: Palette = PALETTES["paper"]) -> None:
    """Write the page; without the recording, the frame slider is left out and the page says so."""
    report = run.report
    frames = report["frames"]
    count = min(run.frames, _MAX_FRAMES)
    chosen = [round(i) for i in np.linspace(0, run.frames - 1, count)]
    try:
        data, brightness = frames_data(run, chosen, palette, min(_FRAME_WIDTH, run.camera.width))
        missing = ""
    except InputError as error:
        data, brightness, missing = {"frames": []}, np.zeros(0), str(error)
    shown = np.array([frame["frame"] for frame in data["frames"]], np.int64)
    known = run.tracks.error[np.isfinite(run.tracks.error)]
    median_error = float(np.median(known)) if len(known) else float("nan")

    page = Page(
        f"Visual odometry of {run.name}",
        f"{frames['processed']} frames of {run.camera.width}x{run.camera.height}, {report['input']['format']}; "
        f"frontend {report['frontend']}; poses and map are {run.unit}.",
        folders=[run.recorded_input.parent, run.path.absolute().parent],
    )
    tracks = run.points.counts()
    truth = true_path(run)
    page.tiles(
        [
            (f"{frames['tracked']} of {frames['processed']}", "frames with a pose"),
            (str(len(report["segments"])), "segments (1 is best)"),
            *_verdict_tile(report),
            (f"{report['points']:,}", "map points"),
            *([(_metres(_path_length(run)), "path of the camera")] if report.get("metric") else []),
            *([(f"{truth.ate_percent:.2g} %", "of the path off the true one (ATE)")] if truth is not None else []),
            (f"{median_error:.2f} px" if np.isfinite(median_error) else "-", "median re-projection error"),
            (f"{report['frames_per_second']:g}", "frames per second"),
            (f"{tracks['stable']:,} / {tracks['unstable']:,}", "stable / unstable tracks"),
        ]
    )
    page.heading("What to look out for")
    page.warnings(warnings(report, shown, brightness, median_error), "Nothing: every frame has a pose, in one segment.")
    doubted = verdict_lines(report, only=DOUBTFUL)  # are among the warnings
    believed = [line for line in verdict_lines(report) if line not in doubted]
    if believed:
        page.paragraph(" ".join(f"{line[0].upper()}{line[1:]}." for line in believed))
    if len(run.trajectory):
        _map_section(page, run, palette, truth)
    _frames_section(page, run, data, palette, missing)
    _charts_section(page, run)
    _labels_section(page, run, palette)
    _timing_section(page, run)
    page.write(path)


def _verdict_tile(report: dict[str, Any]) -> list[tuple[str, str]]:
    """What the odometry itself thinks of its path: the worst segment counts."""
    errors = [verdict_of(segment)["error_percent"] for segment in report["segments"]]
    known = [error for error in errors if error is not None]
    if not known:
        return []
    doubtful = any(verdict_of(segment)["word"] == DOUBTFUL for segment in report["segments"])
    return [(f"{max(known):.1f} %", "estimated error of the path" + (": doubtful" if doubtful else ""))]


def _path_length(run: RunFolder) -> float:
    """Summed over the segments."""
    steps = np.linalg.norm(np.diff(run.trajectory.camera_centers, axis=0), axis=1)
    return float(steps[np.diff(run.trajectory.segment) == 0].sum())


def _metres(length: float) -> str:
    """Four digits, and of what is longer than that all of them."""
    return f"{length:.4g} m" if length < 1000 else f"{length:,.0f} m"


def _map_section(page: Page, run: RunFolder, palette: Palette, truth: TruePath | None) -> None:
    page.heading("Map and trajectory")
    data, good = scene_data(run, palette, truth), len(trusted_points(run.map))
    counts = (
        f"Of {len(run.map):,} map points (map.ply and run.json have all) the {good:,} good ones are shown, seen at "
        "least three times with less than 2 px of error. A label belongs to a track, of which a point may own several: "
        f"there are {len(run.points):,}."
    )
    page.html(
        _SCENE.format(
            gradient=_gradient(palette),
            truth=_TRUTH if truth is not None else "",
            labels=" ".join(_legend(palette, ("stable", "unstable"))),
            counts=plain(counts),
        )
    )
    page.script("scene.js", "scene-data", data)
    if not plots_installed():
        page.paragraph(f"The same as a picture, for prints: {PLOTS_MISSING}.", note=True)
        return
    colours = "from blue to red" if palette.name == "paper" else "from dark to bright"
    page.picture(
        map_png(run, palette),
        f"Seen from above: points as the recording shows them, the trajectory {colours} over time, the last window "
        "black, a pink band under what is doubtful.",
        map_png(run, palette, narrow=True),
    )


def _frames_section(page: Page, run: RunFolder, data: dict[str, object], palette: Palette, missing: str) -> None:
    page.heading("Frames")
    frames = data["frames"]
    assert isinstance(frames, list)
    if not frames:
        page.paragraph(f"The pictures could not be shown: {missing or 'no frame could be read again'}.")
        return
    width = min(2 * _FRAME_WIDTH, 2 * run.camera.width)
    labels = " ".join(_legend(palette, ("stable", "unstable", "ignore")))
    page.html(
        _FRAMES.format(
            last=len(frames) - 1,
            middle=len(frames) // 2,
            width=width,
            height=round(width * run.camera.height / run.camera.width),
            gradient=_gradient(palette),
            labels=labels,
        )
    )
    if len(frames) < run.frames:
        page.paragraph(f"{len(frames)} frames, spread evenly over the run; `improvo show` draws all.", note=True)
    page.script("frames.js", "frame-data", data)


def _charts_section(page: Page, run: RunFolder) -> None:
    page.heading("Over time")
    x = np.arange(run.frames, dtype=np.float64)
    tracks = per_frame(run, lambda rows: float((run.tracks.frame[rows] > run.birth[rows]).sum()))
    page.html(
        f"<figure>{line_chart(x, tracks, 'tracks per frame')}<figcaption>Points per frame that were also seen in the "
        "frame before.</figcaption></figure>"
    )

    def middle(rows: np.ndarray) -> float:
        error = run.tracks.error[rows]
        error = error[np.isfinite(error)]
        return float(np.median(error)) if len(error) else float("nan")

    errors = per_frame(run, middle)
    page.html(
        f"<figure>{line_chart(x, errors, 'median re-projection error, px')}<figcaption>Median re-projection "
        "error per frame in pixels, of all raw tracks under the final poses; a gap where there is no pose.</figcaption>"
        "</figure>"
    )


def _labels_section(page: Page, run: RunFolder, palette: Palette) -> None:
    tracks, rule = run.points.counts(), run.report["configuration"]["labels"]
    page.heading("Labels")
    page.paragraph(
        f"A track of at least {rule['min_observations']} observations is stable if its mean re-projection error is "
        f"at most {rule['stable_mean_error']:g} px, unstable if its largest is at least "
        f"{rule['unstable_max_error']:g} px, and ignored otherwise. A frontend can be trained on these labels."
    )
    names = ("stable", "unstable", "ignore", "withheld")
    rows = [(name, float(tracks[name]), f"{tracks[name]:,}") for name in names]
    page.bars(("label", "tracks"), rows, {name: _css(palette, name) for name in names[:3]})
    page.paragraph(LABEL_WORDS, note=True)


def _timing_section(page: Page, run: RunFolder) -> None:
    report = run.report
    page.heading("Time and settings")
    total = report["seconds"].get("total", 0.0)
    per_frame_ms = 1000.0 / max(run.frames, 1)
    page.bars(
        ("stage", "seconds (per frame)"),
        [
            (name, value, f"{value:.1f} ({value * per_frame_ms:.0f} ms)")
            for name, value in report["seconds"].items()
            if name != "total"
        ],
    )
    page.paragraph(f"{total:.1f} s in all. Stages run side by side, so that their sum may exceed this.", note=True)
    camera = report["camera"]
    page.paragraph(
        f"Camera: {camera['width']}x{camera['height']}, fx {camera['fx']:.2f}, fy {camera['fy']:.2f}, cx "
        f"{camera['cx']:.2f}, cy {camera['cy']:.2f} px; images: {report['input']['view']}; "
        f"input {report['input']['path']}."
    )
    page.details("All settings", as_json(report["configuration"]))
    page.details("Versions", as_json(report["versions"]))


def _css(palette: Palette, label: str) -> str:
    """The colour of a label."""
    return f"rgb{tuple(palette.label_colours(np.array([_CODES[label]]))[0].tolist())}"


def _legend(palette: Palette, labels: Sequence[str]) -> list[str]:
    """Markup: each label behind its colour."""
    return [f"{swatch(_css(palette, label))}{label}" for label in labels]


def _gradient(palette: Palette) -> str:
    colours = ",".join(f"rgb{tuple(colour.tolist())}" for colour in palette.ramp_strip(12))
    return f"linear-gradient(90deg,{colours})"
