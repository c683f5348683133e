"""Label stores of any size in a short time: a camera along a wall, tracks with true errors, packed pictures.

No odometry runs. The tables have the sizes and the spread of those that it writes: 300 observations a frame, tracks of
8 frames on average, one track in fifteen unstable.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np

from improvo.config import to_dict
from improvo.geometry.camera import Camera
from improvo.labeling.frames import FRAMES_FILE, FramesTable, pack_images, write_frames
from improvo.labeling.store import DONE, LabelStore, SequenceRecord
from improvo.sequences import write_trajectory
from improvo.sequences.base import SequenceSettings
from improvo.stability.rule import IGNORE, STABLE, UNSTABLE
from improvo.stability.settings import LabelSettings
from improvo.stability.tables import POINTS_FILE, TRACKS_FILE, PointsTable, PointsWriter, TracksWriter
from improvo.types import Trajectory

CAMERA = Camera(width=320, height=240, fx=260.0, fy=260.0, cx=159.5, cy=119.5)
OBSERVATIONS = 300  # a frame
MEAN_LENGTH = 8  # frames of a track
STEP = 0.02  # of the camera, along x, a frame
UNSTABLE_SHARE = 1 / 15
KINDS = 4  # sequences that differ; the others are copies of them under another name


def write_label_store(folder: Path, frames: int, sequence_frames: int = 1000) -> Path:
    """A store of `frames` frames in sequences of `sequence_frames`; one that is there is kept."""
    if (folder / "complete").is_file():
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    store = LabelStore(folder, {"sequence": to_dict(SequenceSettings()), "labels": to_dict(LabelSettings())})
    for number in range(max(frames // sequence_frames, 1)):
        name = f"synthetic-{number:05d}"
        partial = store.partial(name)
        if number < KINDS:
            counts = _write_sequence(partial, min(sequence_frames, frames), np.random.default_rng(number))
        else:
            shutil.copytree(folder / f"synthetic-{number % KINDS:05d}", partial)
            counts = json.loads((partial / "label.json").read_text())
        record = {**counts, "name": name, "path": f"/nowhere/{name}"}
        (partial / "label.json").write_text(json.dumps(record))
        partial.rename(folder / name)
    store.write_manifest()
    (folder / "complete").touch()
    return folder


def _write_sequence(folder: Path, frames: int, rng: np.random.Generator) -> dict[str, object]:
    folder.mkdir()
    count = OBSERVATIONS * frames // MEAN_LENGTH
    first = np.sort(rng.integers(0, frames, count))
    length = np.minimum(2 + rng.geometric(1 / (MEAN_LENGTH - 2), count), frames - first)
    depth = rng.uniform(2, 5, count)
    pixel = np.stack([rng.uniform(40, CAMERA.width - 40, count), rng.uniform(0, CAMERA.height - 1, count)], axis=1)
    middle = STEP * (first + length / 2)
    xyz = np.stack(
        [
            middle + (pixel[:, 0] - CAMERA.cx) / CAMERA.fx * depth,
            (pixel[:, 1] - CAMERA.cy) / CAMERA.fy * depth,
            depth,
        ],
        axis=1,
    )
    track = np.repeat(np.arange(count), length)
    frame = first[track] + np.arange(len(track)) - np.repeat(np.cumsum(length) - length, length)
    places = np.stack(
        [
            CAMERA.fx * (xyz[track, 0] - STEP * frame) / depth[track] + CAMERA.cx,
            CAMERA.fy * xyz[track, 1] / depth[track] + CAMERA.cy,
        ],
        axis=1,
    ) + rng.normal(0, 0.4, (len(track), 2))
    unstable = rng.uniform(size=count) < UNSTABLE_SHARE
    places[unstable[track], 0] += 1.5 * (frame - first[track])[unstable[track]]  # they move
    stability = np.where(length < 10, IGNORE, np.where(unstable, UNSTABLE, STABLE)).astype(np.int8)
    error = np.where(unstable[track], 4.0, 0.5).astype(np.float64)
    with TracksWriter(folder / TRACKS_FILE) as writer:
        for part in np.array_split(np.arange(len(track)), max(len(track) // 50_000, 1)):
            writer.write(frame[part], track[part], places[part], np.ones(len(part)), error[part])
    with PointsWriter(folder / POINTS_FILE) as writer:
        writer.write(
            PointsTable(
                track=np.arange(count), point=np.where(unstable, -1, np.arange(count) // 2 * 2), xyz=xyz,
                observations=length, mean_error=np.where(unstable, 4.0, 0.5).astype(np.float32),
                max_error=np.where(unstable, 9.0, 1.0).astype(np.float32), stability=stability,
                segment=np.zeros(count, np.int64), parallax_deg=np.full(count, 5.0, np.float32),
                withheld=np.zeros(count, np.bool_),
            )
        )  # fmt: skip
    numbers = np.arange(frames)
    write_frames(
        folder / FRAMES_FILE,
        FramesTable(numbers, numbers, numbers / 30, np.zeros(frames, np.int64), np.ones(frames, np.bool_)),
    )
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = STEP * numbers
    write_trajectory(folder / "trajectory.txt", Trajectory(numbers / 30, poses))
    (folder / "run.json").write_text(json.dumps({"camera": to_dict(CAMERA)}))
    texture = cv2.GaussianBlur(rng.integers(0, 256, (CAMERA.height, 4 * CAMERA.width)).astype(np.uint8), (0, 0), 1.5)
    pack_images(folder, ((np.roll(texture, -5 * n, axis=1)[:, : CAMERA.width], None) for n in range(frames)))
    record = SequenceRecord(
        "", "", DONE, frames=frames, tracked=frames, trusted=frames, segments=1, tracks=count, packed=True,
        stable=int((stability == STABLE).sum()), unstable=int((stability == UNSTABLE).sum()),
    )  # fmt: skip
    return to_dict(record)
