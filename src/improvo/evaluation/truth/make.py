"""`improvo truth`: reference poses of a recording by structure from motion, metric, and refused where they are bad."""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from improvo.config import to_dict
from improvo.errors import ConfigError, InputError
from improvo.evaluation.truth.metric_scale import MetricScale, scale_from_depth, scale_from_poses
from improvo.evaluation.truth.motion_check import MotionCheck, check_motion
from improvo.evaluation.truth.reference import ReferencePoses, read_reference, write_reference
from improvo.evaluation.truth.referenced import ReferencedSequence, frames_of
from improvo.evaluation.truth.settings import TruthSettings
from improvo.evaluation.truth.structure_from_motion import (
    Progress,
    Reconstruction,
    read_reconstruction,
    reconstruct,
)
from improvo.files import make_output_folder, write_json
from improvo.folder_lock import locked
from improvo.geometry.camera import Camera
from improvo.geometry.se3 import inverse
from improvo.sequences import Sequence
from improvo.sequences.base import UnreadableFrameError
from improvo.types import Float32, Float64, Int64
from improvo.untrusted.text import read_json_file

COMMAND = "truth"
_DECIDING = ("max_features", "overlap", "farthest", "calibrate", "seed")  # settings that decide the reconstruction


@dataclass(frozen=True)
class TruthQuality:
    """What a made truth says about itself."""

    frames: int  # selected
    registered: int
    points: int
    mean_track_length: float
    mean_reprojection_px: float
    scale_by: str  # depth, or the file of the trajectory
    scale_images: int
    scale_spread: float  # relative, between images
    disagreement: float  # with depth or trajectory, relative
    aspect_change: float = 0.0  # of fy / fx against the given camera; a lens has none, an uncertain camera has
    motion: MotionCheck | None = None  # against motions by depth; None where the scale is not from depth

    def faults(self, settings: TruthSettings) -> list[str]:
        """Why it must not be written; empty where it may."""
        found = []
        share = self.registered / self.frames
        if share < settings.min_registered:
            found.append(f"{self.registered} of {self.frames} frames registered (min_registered)")
        if not self.mean_reprojection_px <= settings.max_reprojection_px:
            found.append(f"{self.mean_reprojection_px:.2f} px mean error (max_reprojection_px)")
        if not self.scale_spread <= settings.max_scale_spread:
            found.append(f"scale differs by {100 * self.scale_spread:.1f} % between frames (max_scale_spread)")
        if not self.disagreement <= settings.max_disagreement:
            found.append(f"{100 * self.disagreement:.1f} % off {self.scale_by} (max_disagreement)")
        if self.motion is not None and not abs(self.motion.length_ratio - 1) <= settings.max_motion_error:
            found.append(f"motions by depth are {self.motion.length_ratio:.3f} times as long (max_motion_error)")
        if not abs(self.aspect_change) <= settings.max_aspect_change:
            found.append(
                f"fy / fx differs by {100 * self.aspect_change:+.1f} % from the given camera's (max_aspect_change), so "
                "the camera is uncertain: take more frames that turn, or --calibrate none"
            )
        return found

    def text(self) -> str:
        """A line for a person."""
        return (
            f"{self.registered} of {self.frames} frames registered, {self.points} points in "
            f"{self.mean_track_length:.1f} images each, mean error {self.mean_reprojection_px:.2f} px; scale by "
            f"{self.scale_by} of {self.scale_images} frames, spread {100 * self.scale_spread:.1f} %, "
            f"off by {100 * self.disagreement:.1f} %"
            + (f"; motions by depth {self.motion.length_ratio:.3f} times as long" if self.motion else "")
        )


def make_truth(
    sequence: Sequence,
    output: Path,
    settings: TruthSettings,
    *,
    scale_from: str | None = None,
    model: Path | None = None,
    threads: int = 1,
    progress: Progress = lambda stage, done, total: None,
) -> TruthQuality:
    """Write reference poses of the selected frames, and their quality beside them as JSON.

    The working folder (`output` with the ending `.work`) stays, so that an interrupted call goes on.

    Args:
        sequence: opened without a resize.
        output: the file to write.
        settings: of the reconstruction, and the limits of its quality.
        scale_from: poses in metres of some of the frames (TUM, or by frame number); without it depth gives the scale.
        model: a COLMAP model of these frames, in place of structure from motion.
        threads: of COLMAP.
        progress: told after every step.

    Raises:
        InputError: no reconstruction, no depth, or a quality below the limits.
        BusyError: another process works on the same output.
        MissingExtraError: without `pycolmap`.
    """
    if sequence.settings.width is not None:
        raise ConfigError("truth: leave out --width; the camera and poses are those of the raw images")
    metric = None if scale_from is None else read_reference(scale_from)
    if model is not None:
        found = read_reconstruction(model)
    else:
        folder = output.with_suffix(".work")
        make_output_folder(folder, COMMAND)
        with locked(folder):  # two in one database would spoil each other's
            _check_request(folder, sequence, settings)
            found = reconstruct(sequence, folder, settings, threads, progress)
    names = tuple(image.name for image in found.images)
    world_from_cam = inverse(np.stack([image.cam_from_world for image in found.images]))
    frames = frames_of(ReferencePoses(str(model or sequence.path), world_from_cam, names=names), sequence.recording)
    scale, motion = _scale(found, sequence, frames, world_from_cam, metric, settings)
    quality = TruthQuality(
        frames=len(sequence),
        registered=len(frames),
        points=found.points,
        mean_track_length=found.mean_track_length,
        mean_reprojection_px=found.mean_error_px,
        scale_by="depth" if scale_from is None else scale_from,
        scale_images=scale.images,
        scale_spread=scale.spread,
        disagreement=scale.disagreement,
        aspect_change=_aspect(found.camera) / _aspect(sequence.raw_camera) - 1.0,
        motion=motion,
    )
    faults = quality.faults(settings)
    if faults:
        raise InputError(f"{output}: not written, since the poses are not good enough: {'; '.join(faults)}")
    poses = np.array(world_from_cam)
    poses[:, :3, 3] *= scale.scale
    order = np.argsort(frames)
    write_reference(output, found.camera, frames[order], poses[order], comments=(f"improvo truth: {quality.text()}",))
    write_json(output.with_suffix(".json"), {"quality": to_dict(quality), "settings": to_dict(settings)})
    return quality


def _aspect(camera: Camera) -> float:
    return camera.fy / camera.fx


def _check_request(folder: Path, sequence: Sequence, settings: TruthSettings) -> None:
    """Refuse a working folder that was made with other frames or settings."""
    mask = sequence.raw_mask(0)
    wanted: dict[str, Any] = {
        "recording": str(sequence.path.absolute()),
        "frames": [int(sequence.indices[0]), int(sequence.indices[-1]), len(sequence)],
        "camera": to_dict(sequence.raw_camera),
        "settings": {name: getattr(settings, name) for name in _DECIDING},
    }
    if mask is not None:
        wanted["first_mask"] = zlib.crc32(mask.tobytes())
    request = folder / "request.json"
    mend = "delete that folder to begin anew"
    if request.is_file() and read_json_file(request, mend) != json.loads(json.dumps(wanted)):
        raise InputError(f"{folder}: was begun with other frames or settings; {mend}")
    write_json(request, wanted)


def _scale(
    found: Reconstruction,
    sequence: Sequence,
    frames: Int64,
    world_from_cam: Float64,
    metric: ReferencePoses | None,
    settings: TruthSettings,
) -> tuple[MetricScale, MotionCheck | None]:
    """The scale, and where it is by depth, the check of motions by depth."""
    if metric is not None:
        whole = replace(sequence.settings, start=0, end=None, stride=1, max_frames=None)
        truth = ReferencedSequence(sequence.recording, whole, replace(metric, calibration=None)).ground_truth
        assert truth is not None
        try:
            return scale_from_poses(world_from_cam, truth.world_from_cam[frames]), None
        except InputError as error:
            raise InputError(f"{metric.source}: gives no scale ({error})") from None

    def depth(row: int) -> Float32 | None:
        try:
            return sequence.recording.depth(int(frames[row]))
        except UnreadableFrameError:
            return None

    scale = scale_from_depth(found.images, depth, settings.min_depths)
    if scale is None:
        raise InputError(f"{sequence.path}: has no depth that gives the scale; give poses in metres with --scale-from")
    return scale, check_motion(found.images, found.camera, depth, scale.scale, settings.seed)
