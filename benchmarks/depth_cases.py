"""What `benchmarks/depth.py` measures on: recordings with poses to sweep over, and the truth to judge by."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from improvo import config
from improvo.depth.depth_maps import Range
from improvo.depth.sparse_depths import ranges_of_run
from improvo.evaluation.truth.reference import read_reference
from improvo.evaluation.truth.referenced import open_with_truth
from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.odometry.run.run_folder import RunFolder
from improvo.sequences import Sequence, SequenceSettings, open_sequence
from improvo.types import Float32, Float64, Int64

DATA = Path(__file__).parents[2] / "shared" / "data"
ROOMS = {"room-easy": ("easy", 902), "room-home": ("home", 901)}  # preset and seed
RECORDINGS = ("redkitchen", "hololens-office", "fr3-notexture", *ROOMS)
GAPS = {"hololens-office": (1, 2, 4, 6)}  # keyframes, each as wide as 15 to 30 frames of a video
VIDEO_GAPS = (10, 30, 60, 90)


@dataclass(frozen=True)
class Truth:
    """Depth images and poses."""

    sequence: Sequence  # its depth images; frames are those of the case
    camera: Camera  # with distortion, of the pictures that the case delivers
    cam_from_world: Float64  # (N, 4, 4), NaN where there is none

    def depth(self, frame: int, size: tuple[int, int]) -> Float32 | None:
        """(h, w) metres at the pixels of a map of half the size, NaN where missing or at an edge."""
        depth = self.sequence.depth(frame)
        if depth is None:
            return None
        width, height = size
        cut = depth[: 2 * height, : 2 * width]
        four = np.stack([cut[0::2, 0::2], cut[1::2, 0::2], cut[0::2, 1::2], cut[1::2, 1::2]])
        with np.errstate(invalid="ignore"):
            smooth = (four.min(axis=0) > 0) & (four.max(axis=0) - four.min(axis=0) < 0.05 * four.min(axis=0))
        return np.where(smooth, four.mean(axis=0), np.nan).astype(np.float32)

    def project(self, points_cam: Float64) -> Float64:
        """Points (N, 3) -> pixels (N, 2), with the distortion."""
        rays = self.camera.distort(points_cam[:, :2] / points_cam[:, 2:])
        return np.asarray(rays * [self.camera.fx, self.camera.fy] + [self.camera.cx, self.camera.cy])

    def unproject(self, pixels: Float64, depth: Float64) -> Float64:
        """Pixels (N, 2) at depth (N,) -> points (N, 3)."""
        distortion = np.array(self.camera.distortion) if self.camera.distortion else None
        rays = cv2.undistortPoints(pixels.reshape(-1, 1, 2), self.camera.K, distortion).reshape(-1, 2)
        return np.concatenate([rays, np.ones((len(rays), 1))], axis=1) * depth[:, None]


@dataclass(frozen=True)
class Case:
    """One recording with the poses to sweep over."""

    name: str
    sequence: Sequence
    cam_from_world: Float64
    segment: Int64
    ranges: Callable[[int], Range | None]
    truth: Truth
    gaps: tuple[int, ...]


def cases(names: list[str], runs: Path, frames: int | None) -> Iterator[Case]:
    """`recording/truth` sweeps over true poses, `recording/own` over those of the odometry.

    Args:
        names: such as `redkitchen/own`; a recording alone means both.
        runs: folder for rendered rooms and for runs of the odometry; what is there is used again.
        frames: at most so many of each recording.
    """
    for name in names or list(RECORDINGS):
        recording, _, poses = name.partition("/")
        for kind in (poses,) if poses else ("truth", "own"):
            yield _case(recording, kind, runs, frames)


def _case(recording: str, poses: str, runs: Path, frames: int | None) -> Case:
    path = _room(recording, runs) if recording in ROOMS else DATA / recording
    settings = SequenceSettings(max_frames=frames)
    plain, file = open_sequence(path, settings), path / "truth-sfm.txt"
    true_sequence = open_with_truth(str(path), settings, str(file)) if file.is_file() else plain
    truth_poses = true_sequence.ground_truth
    assert truth_poses is not None, f"{path} has no true poses"
    true_cam_from_world = np.full((len(plain), 4, 4), np.nan)
    true_cam_from_world[truth_poses.valid] = se3.inverse(truth_poses.world_from_cam[truth_poses.valid])
    name, gaps = f"{recording}/{poses}", GAPS.get(recording, VIDEO_GAPS)
    if poses == "truth":
        truth = Truth(true_sequence, true_sequence.camera, true_cam_from_world)
        segment = np.where(truth_poses.valid, 0, -1)
        return Case(name, true_sequence, true_cam_from_world, segment, lambda _: None, truth, gaps)
    camera = plain.camera
    if file.is_file():  # the odometry has the nominal camera, the truth a calibrated one
        calibration = read_reference(file).calibration
        assert calibration is not None
        camera = calibration.camera(camera.width, camera.height)
    truth = Truth(plain, camera, true_cam_from_world)
    run = RunFolder(_run(recording, path, runs, frames))
    cam_from_world, segment = np.full((len(plain), 4, 4), np.nan), np.full(len(plain), -1)
    rows = np.searchsorted(plain.indices, np.array(run.source_index)[run.frame_indices])
    cam_from_world[rows], segment[rows] = se3.inverse(run.trajectory.world_from_cam), run.trajectory.segment
    ranges = ranges_of_run(run.path / "points.parquet", run.path / "tracks.parquet", cam_from_world, segment)
    cam_from_world[~np.isfinite(ranges).all(axis=1)] = np.nan
    return Case(name, plain, cam_from_world, segment, lambda row: tuple(ranges[row].tolist()), truth, gaps)


def _room(recording: str, runs: Path) -> Path:
    from improvo.simulation.generate import simulate
    from improvo.simulation.settings import preset

    folder = runs / recording
    if not (folder / "rgb.txt").is_file():
        kind, seed = ROOMS[recording]
        simulate(preset(kind, frames=200, seed=seed), folder)
    return folder


def _run(recording: str, path: Path, runs: Path, frames: int | None) -> Path:
    from improvo.labeling.labeler import run_and_label
    from improvo.odometry.run_settings import RunSettings

    folder = runs / (f"run-{recording}" + (f"-{frames}" if frames else ""))
    if not (folder / "run.json").is_file():
        settings = config.from_dict(RunSettings, {"sequence": {"max_frames": frames}})
        run_and_label(open_sequence(path, settings.sequence), folder, settings)
    return folder
