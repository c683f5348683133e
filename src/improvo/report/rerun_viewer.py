"""The live viewer: camera, image, tracks, map and timings in Rerun, while a run goes on or of a finished one.

Entities are named as in Rerun's own SLAM examples: `world/points`, `world/camera/image`, `world/trajectory`.
"""

from __future__ import annotations

import os
import shutil
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import OutputError, first_line, imported
from improvo.files import check_output_file, written_atomically
from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.odometry.run.run_folder import RunFolder
from improvo.odometry.view import View
from improvo.report.map_picture import map_colours
from improvo.report.palettes import PALETTES, Palette
from improvo.stability.rule import IGNORE
from improvo.types import Float64, Frame, UInt8

_PROGRAM = "rerun"
_OLD = 30  # frames; the last colour of the age of a track
_MAP_EVERY = 10  # frames between two pictures of the whole map, at least
_MAP_GROWTH = 1.1  # of its points between two such pictures: all of them together stay a few times the last one
_PIECE = 100  # poses of the trajectory that are sent anew with every frame; what lies behind stays as it is


class RerunViewer:
    """An `improvo.odometry.visualizer.Visualizer` that shows a run in Rerun.

    Args:
        save: a `.rrd` file to write, which works without a screen; None opens the viewer.
        palette: colours.

    Raises:
        MissingExtraError: Rerun is not installed.
        OutputError: the file cannot be written.
    """

    def __init__(self, save: Path | None = None, palette: Palette = PALETTES["paper"]) -> None:
        self._recording = _Recording(save)
        self.failure: OutputError | None = None  # of the file to save, when the run is over
        self._palette = palette
        self._births: dict[int, int] = {}  # track -> the frame where it began
        self._path: list[Float64] = []  # the newest piece
        self._pieces = 0  # behind it
        self._world = -1
        self._map: Float64 = np.zeros((0, 3))  # the newest one
        self._map_shown = 0  # points of the last picture of it
        self._last_shown = time.perf_counter()

    def begin(self, camera: Camera) -> None:
        """A run begins."""
        self._recording.open(camera)
        self._last_shown = time.perf_counter()

    def show(self, frame: Frame, view: View, points: Float64) -> None:
        """A frame was processed."""
        recording, now = self._recording, time.perf_counter()
        recording.at(view.frame_index, view.time)
        self._births = {track: self._births.get(track, view.frame_index) for track in view.tracks.tolist()}
        age = view.frame_index - np.array([self._births[track] for track in view.tracks.tolist()], np.int64)
        colours = self._palette.ramp_colours(age, 0, _OLD)
        recording.image(frame.image)
        recording.keypoints(view.keypoints, colours)
        recording.scalar("plots/tracks", float((age > 0).sum()))
        recording.scalar("plots/points_observed", float(len(view.observed)))
        recording.scalar("plots/milliseconds_per_frame", 1000.0 * (now - self._last_shown))
        self._last_shown = now
        if view.cam_from_world is not None:
            self._show_pose(view, points)

    def _show_pose(self, view: View, points: Float64) -> None:
        assert view.cam_from_world is not None
        world_from_cam = se3.inverse(view.cam_from_world)
        if view.world != self._world:  # another world: no line leads there
            self._world, self._path, self._pieces, self._map_shown = view.world, [], 0, 0
            self._recording.clear("world/trajectory")
        self._path.append(world_from_cam[:3, 3])
        self._show_path()
        self._map = points
        if view.frame_index % _MAP_EVERY == 0 and len(points) > _MAP_GROWTH * self._map_shown:
            self._show_map()
        seen = view.points[view.observed]
        if len(seen) and int(seen.max()) < len(points):
            weights = view.weights[view.observed]  # stability, or 1 without that head
            self._recording.points(points[seen], self._palette.ramp_colours(1 - weights, 0, 1), "world/observed")

    def _show_path(self) -> None:
        """The newest piece from early to late; a piece that is full stays behind in the early colour."""
        place = f"world/trajectory/{self._pieces}"
        if len(self._path) <= _PIECE:
            self._recording.trajectory(np.array(self._path), self._palette, place)
            return
        early = self._palette.ramp_strip(1)
        self._recording.links(np.array(self._path), np.repeat(early, len(self._path) - 1, axis=0), place)
        self._path, self._pieces = self._path[-1:], self._pieces + 1

    def _show_map(self) -> None:
        self._recording.points(self._map, np.full((len(self._map), 3), 200, np.uint8))
        self._map_shown = len(self._map)

    def end(self) -> None:
        """The run is over. What the file could not hold must not cost its results, so `failure` keeps the error."""
        try:
            if len(self._map):
                self._show_map()
            self._recording.close()
        except OutputError as error:
            self.failure = error


def show_run(
    run: RunFolder, save: Path | None = None, palette: Palette = PALETTES["paper"], images: bool = True
) -> None:
    """A finished run in Rerun: as `RerunViewer`, with the map coloured by the stability labels.

    Args:
        run: the finished run.
        save: a `.rrd` file to write; None opens the viewer.
        palette: colours.
        images: show the frames too; needs the recording.
    """
    if images:
        _ = run.sequence  # said before a file is begun, where it is not there any more
    recording = _Recording(save)
    recording.open(run.camera)
    row_of_frame = {int(frame): row for row, frame in enumerate(run.frame_indices)}
    times = _times(run)
    labelled = np.flatnonzero((run.points.stability != IGNORE) & np.isfinite(run.points.xyz).all(axis=1))
    recording.points(
        run.points.xyz[labelled], palette.label_colours(run.points.stability[labelled]), "world/labels", static=True
    )
    recording.points(run.map.xyz, map_colours(run.map), static=True)
    for segment in np.unique(run.trajectory.segment).tolist():  # no line leads from one to the next
        here = run.trajectory.segment == segment
        recording.trajectory(run.trajectory.camera_centers[here], palette, f"world/trajectory/{segment}", static=True)
    for frame in range(run.frames):
        row = row_of_frame.get(frame)
        recording.at(frame, float(times[frame]))
        if images:
            recording.image(run.image(frame))
        seen = run.observations(frame)
        recording.keypoints(seen.keypoints, palette.label_colours(seen.stability))
        recording.scalar("plots/tracks", float((seen.age > 0).sum()))
        if np.isfinite(seen.error).any():
            recording.scalar("plots/median_error", float(np.nanmedian(seen.error)))
        if row is not None:
            recording.pose(run.trajectory.world_from_cam[row])
    recording.close()


def _times(run: RunFolder) -> Float64:
    """(frames,) seconds; of frames without a pose as the frames with one tell, since the recording may be away."""
    if len(run.trajectory) == 0:
        return np.arange(run.frames, dtype=np.float64)
    numbers = np.array(run.source_index, np.float64)
    known = numbers[run.frame_indices]
    times = np.interp(numbers, known, run.trajectory.times)
    if len(known) > 1:
        step = (run.trajectory.times[-1] - run.trajectory.times[0]) / (known[-1] - known[0])
        times += step * (np.minimum(numbers - known[0], 0) + np.maximum(numbers - known[-1], 0))
    return times


def _program_path() -> str:
    """Where programs are looked for: also beside this Python, whose folder is in no PATH unless it was activated."""
    return os.pathsep.join([os.environ.get("PATH", os.defpath), str(Path(sys.executable).parent)])


class _Recording:
    """Rerun's recording stream, in our nouns."""

    def __init__(self, save: Path | None) -> None:
        rerun = imported("rerun", "the live viewer", "view")
        if save is not None:
            check_output_file(save, (".rrd",))
            if not save.absolute().parent.is_dir():
                raise OutputError(f"{save}: no folder {save.parent}; make it first")
        elif shutil.which(_PROGRAM, path=_program_path()) is None:
            raise OutputError(
                f"the live viewer: no program `{_PROGRAM}` is found; install it, or save a file to open later"
            )
        self._rerun: Any = rerun
        self._save = save
        self._files = ExitStack()
        self._stream: Any = None

    def open(self, camera: Camera) -> None:
        self._stream = self._rerun.RecordingStream("improvo")
        if self._save is None:
            os.environ["PATH"] = _program_path()
            try:
                self._stream.spawn()
            except RuntimeError as error:
                raise OutputError(
                    f"the live viewer does not start ({first_line(error)}); save a file, and open it later"
                ) from None
        else:
            self._stream.save(str(self._files.enter_context(written_atomically(self._save))))
        self._log("world", self._rerun.ViewCoordinates.RDF, static=True)
        pinhole = self._rerun.Pinhole(
            image_from_camera=camera.K, resolution=[camera.width, camera.height], image_plane_distance=0.15
        )
        self._log("world/camera/image", pinhole, static=True)

    def close(self) -> None:
        with self._files:
            try:
                self._stream.flush()
            except RuntimeError:  # what Rerun says when its writer could not go on
                if self._save is not None:
                    raise OutputError(f"{self._save}: cannot be written (is the disk full?); choose another") from None
            finally:
                self._stream.disconnect()

    def _log(self, path: str, what: Any, static: bool = False) -> None:
        self._stream.log(path, what, static=static)

    def at(self, frame: int, seconds: float) -> None:
        """What follows belongs to this frame."""
        self._stream.set_time("frame", sequence=frame)
        self._stream.set_time("time", duration=seconds)

    def image(self, image: UInt8) -> None:
        self._log("world/camera/image", self._rerun.Image(image, color_model="L").compress(jpeg_quality=75))

    def keypoints(self, pixels: Float64, colours: UInt8) -> None:
        # Rerun's pixel centres are at one half
        self._log("world/camera/image/keypoints", self._rerun.Points2D(pixels + 0.5, colors=colours, radii=2.0))

    def pose(self, world_from_cam: Float64) -> None:
        transform = self._rerun.Transform3D(translation=world_from_cam[:3, 3], mat3x3=world_from_cam[:3, :3])
        self._log("world/camera", transform)

    def points(self, xyz: Float64, colours: UInt8, path: str = "world/points", static: bool = False) -> None:
        self._log(path, self._rerun.Points3D(xyz, colors=colours, radii=self._rerun.Radius.ui_points(1.5)), static)

    def trajectory(self, centres: Float64, palette: Palette, path: str, static: bool = False) -> None:
        """From early to late."""
        self.links(centres, palette.ramp_colours(np.arange(len(centres) - 1), 0, len(centres) - 1), path, static)

    def links(self, centres: Float64, colours: UInt8, path: str, static: bool = False) -> None:
        if len(centres) > 1:
            strips = np.stack([centres[:-1], centres[1:]], axis=1)
            self._log(path, self._rerun.LineStrips3D(strips, colors=colours), static)

    def clear(self, path: str) -> None:
        self._log(path, self._rerun.Clear(recursive=True))

    def scalar(self, path: str, value: float) -> None:
        self._log(path, self._rerun.Scalars(value))
