"""The reference: one run of the frontend at the start over whole recordings, with depth, made once.

Its poses and depth maps teach on the training part and judge on the part held back, the same for all candidates. The
depth maps of either part are made from frames of that part alone, so that nothing of what is held back is trained on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from improvo.depth.archive import DepthReader, DepthWriter
from improvo.depth.dense import without_masked
from improvo.depth.depth_map import half_intrinsics
from improvo.depth.depth_maps import depth_maps
from improvo.depth.sparse_depths import ranges_of_run
from improvo.errors import InputError
from improvo.evaluation.pose.self_truth import FixedRun
from improvo.frontend import Frontend
from improvo.geometry import se3
from improvo.improvement.settings import ReferenceSettings
from improvo.improvement.split import Part
from improvo.labeling.labeled import LabeledSequence, read_labels
from improvo.sequences import open_sequence
from improvo.stability.tables import POINTS_FILE, TRACKS_FILE
from improvo.training.data.posed_sequence import PosedSequence
from improvo.types import Features, Float32, Float64, Int64, Mask, UInt8

TRAINING, HELD_BACK = "training", "held-back"


@dataclass(frozen=True)
class ReferencePart:
    """The frames of one recording that belong to one part, with poses, and depth maps of some of them."""

    name: str  # of the recording
    labeled: LabeledSequence  # the reference run over the whole recording
    frames: Int64  # (N,) frame_index of the part's frames in it
    depth_file: Path
    earlier: bool = False  # of a run of the loop before this one

    def fixed_run(self) -> FixedRun:
        """Poses and depth of the part's frames; every other frame of the run has no pose."""
        reader = DepthReader(self.depth_file)
        poses, segment = _poses_of(self.labeled, self.frames)
        world_from_cam = poses.copy()
        posed = segment >= 0
        world_from_cam[posed] = se3.inverse(poses[posed])
        has_depth = np.zeros(len(segment), np.bool_)
        has_depth[reader.frames] = True
        return FixedRun(self.labeled.camera, world_from_cam, segment, has_depth, reader.depth)

    def features(self, frontend: Frontend, frame: int) -> Features:
        """Of a frame, none of them on a masked pixel."""
        image, mask = self.labeled.image(frame), self.labeled.mask(frame)
        return frontend(image) if mask is None else frontend(image, mask)

    def teaching_frames(self, longer_side: int) -> list[PosedSequence]:
        """Pictures, poses and depth of the frames with a depth map, segment by segment.

        Args:
            longer_side: pixels; larger pictures are reduced, and the camera with them.
        """
        run, reader = self.fixed_run(), DepthReader(self.depth_file)
        camera, frames = run.camera, np.array(reader.frames, np.int64)
        scale = min(1.0, longer_side / max(camera.width, camera.height))
        size = round(camera.width * scale), round(camera.height * scale)
        change = np.diag([size[0] / camera.width, size[1] / camera.height, 1.0])
        half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # from pixel centres to pixel edges
        K = np.linalg.inv(half) @ change @ half @ camera.K
        found = []
        for number in np.unique(run.segment[frames]).tolist():
            own = frames[run.segment[frames] == number]
            if len(own) < 2:
                continue
            pictures = tuple(_reduced(self.labeled.image(int(frame)), size) for frame in own)
            depths = tuple(_inverse(reader.depth(int(frame))) for frame in own)
            times = self.labeled.frames.time[own]
            masks = [self.labeled.mask(int(frame)) for frame in own]
            used = tuple(_reduced_mask(mask, size) for mask in masks if mask is not None)
            masks_of_all = used if len(used) == len(own) else ()
            found.append(
                PosedSequence(self.name, pictures, times, K, run.world_from_cam[own], depths, masks=masks_of_all)
            )
        return found


def reference_parts(store: Path, part: Part, kind: str) -> list[ReferencePart]:
    """The part's share of the reference run, recording by recording; those without a run are left out.

    Args:
        store: label store of the reference run.
        part: training part or what is held back.
        kind: `TRAINING` or `HELD_BACK`.
    """
    wanted = {str(path.resolve()) for path in part.paths}
    found = []
    for labeled in read_labels(store):
        if str(Path(labeled.record.path).resolve()) not in wanted:
            continue
        indices = open_sequence(Path(labeled.record.path), part.sequence).indices
        frames = np.flatnonzero(np.isin(labeled.frames.source_index, indices))
        found.append(ReferencePart(labeled.name, labeled, frames, labeled.folder / f"depth-{kind}.zip"))
    return found


@dataclass(frozen=True)
class DepthJob:
    """What `make_depth` does in a worker."""

    part: ReferencePart
    most: int
    settings: ReferenceSettings


def do_depth_job(job: DepthJob, tick: Callable[[], None]) -> None:
    """Depth maps of a part."""
    make_depth(job.part, job.most, job.settings, tick)


def make_depth(
    part: ReferencePart, most: int, settings: ReferenceSettings, tick: Callable[[], None] = lambda: None
) -> None:
    """Depth maps of frames of a part, from frames of that part alone; nothing where they are there already.

    Args:
        part: of one recording.
        most: frames that get a depth map.
        settings: how often, and of the plane sweep.
        tick: called after every frame.
    """
    if part.depth_file.is_file():
        return
    labeled = part.labeled
    poses, segment = _poses_of(labeled, part.frames)
    chosen = frames_with_depth(labeled.frames.time, np.flatnonzero(segment >= 0), most, settings)
    ranges = ranges_of_run(labeled.folder / POINTS_FILE, labeled.folder / TRACKS_FILE, poses, segment)
    chosen = chosen[np.isfinite(ranges[chosen]).all(axis=1)]
    seen = np.full_like(poses, np.nan)
    seen[chosen] = poses[chosen]
    K = labeled.camera.K
    with DepthWriter(part.depth_file, half_intrinsics(K)) as writer:
        for frame, found in depth_maps(
            labeled.image, seen, segment, K, lambda row: _triple(ranges[row]), settings.depth
        ):
            unmasked = without_masked(found, labeled.mask(frame))
            if unmasked.known >= settings.least_known:
                writer.write(frame, unmasked.depth)
            tick()


def frames_with_depth(times: Float64, frames: Int64, most: int, settings: ReferenceSettings) -> Int64:
    """Which frames get a depth map: thinned out evenly, and where they are still too many, in whole stretches.

    Args:
        times: (N,) seconds of all frames.
        frames: (M,) those to choose from, increasing.
        most: how many to choose.
        settings: how densely.
    """
    if len(frames) < 2:
        return frames
    usual = max(float(np.median(np.diff(times[frames]))), 1e-9)
    sparsest = max(round(1 / (settings.frames_per_second * usual)), 1)
    thinned = frames[:: int(np.clip(np.ceil(len(frames) / min(settings.dense_up_to, most)), 1, sparsest))]
    if len(thinned) <= most:
        return thinned
    stretch = np.floor((times[thinned] - times[thinned[0]]) / settings.stretch_seconds).astype(np.int64)
    numbers, counts = np.unique(stretch, return_counts=True)
    wanted = max(1, int(most / counts.mean()))
    kept = numbers[np.unique(np.linspace(0, len(numbers) - 1, wanted).round().astype(np.int64))]
    return thinned[np.isin(stretch, kept)][:most]


def refuse_without_depth(parts: list[ReferencePart], what: str, mend: str) -> None:
    """Training and validation both need depth.

    Raises:
        InputError: no frame of the parts has a depth map.
    """
    if not any(DepthReader(part.depth_file).frames for part in parts):
        names = ", ".join(part.name for part in parts) or "no recording"
        raise InputError(
            f"{what} ({names}): no frame has depth, because the camera moved too little or turned more than it moved, "
            f"because its path is not known well enough, or for want of texture; {mend}"
        )


def _poses_of(labeled: LabeledSequence, frames: Int64) -> tuple[Float64, Int64]:
    """(N, 4, 4) cam_from_world and (N,) segment of the whole run, with NaN and -1 outside of `frames`."""
    poses, segment = np.full_like(labeled.cam_from_world, np.nan), np.full(len(labeled.frames), -1, np.int64)
    poses[frames], segment[frames] = labeled.cam_from_world[frames], labeled.frames.segment[frames]
    segment[~np.isfinite(poses).all(axis=(1, 2))] = -1
    return poses, segment


def _reduced(image: UInt8, size: tuple[int, int]) -> UInt8:
    if (image.shape[1], image.shape[0]) == size:
        return image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _reduced_mask(mask: Mask, size: tuple[int, int]) -> Mask:
    """Used is what only used pixels have a part in."""
    return np.asarray(cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA) == 255)


def _inverse(depth: Float32) -> Float32:
    known = depth > 0
    return np.where(known, 1 / np.where(known, depth, 1), 0).astype(np.float32)


def _triple(values: Float64) -> tuple[float, float, float]:
    near, median, far = values.tolist()
    return near, median, far
