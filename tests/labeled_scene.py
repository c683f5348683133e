"""A label store with known truth: dots on two walls, a camera that moves sideways, exact tracks, packed frames."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from improvo.config import to_dict
from improvo.geometry.camera import Camera
from improvo.labeling.frames import FRAMES_FILE, FramesTable, pack_images, write_frames
from improvo.labeling.store import DONE, LabelStore, SequenceRecord, finish_sequence
from improvo.sequences import write_trajectory
from improvo.sequences.base import SequenceSettings
from improvo.stability.rule import IGNORE, STABLE, UNSTABLE
from improvo.stability.settings import LabelSettings
from improvo.stability.tables import POINTS_FILE, TRACKS_FILE, PointsTable, PointsWriter, TracksWriter
from improvo.types import Float64, Trajectory

CAMERA = Camera(width=160, height=120, fx=120.0, fy=120.0, cx=79.5, cy=59.5)
FRAMES = 40
FAR, NEAR = 4.0, 2.0  # depths of the walls
HALF = 15  # tracks of odd far points end here; a second track of the same map point begins 3 frames later
UNSTABLE_FROM = 1.6  # x of the world: dots right of it are labelled unstable, and look different


def camera_x(frame: int) -> float:
    """Where the camera is; it looks along +z and does not turn."""
    return 0.03 * frame


def write_labeled_scene(
    folder: Path,
    name: str = "walls",
    keypoint_noise: float = 0.0,
    unstable_error: float = 4.0,
    wrong_link: bool = False,
    frames: int = FRAMES,
    every: int = 1,
) -> Path:
    """A label store with one finished, packed sequence, with a track of every `every`-th dot; returns the store.

    Unstable dots glide along their wall as the frames go by; with `wrong_link` their tracks jump once instead.
    """
    rng = np.random.default_rng(0)
    xyz = scene_points()
    store = LabelStore(folder, {"sequence": to_dict(SequenceSettings()), "labels": to_dict(LabelSettings())})
    partial = store.partial(name)
    partial.mkdir()
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = [camera_x(frame) for frame in range(frames)]
    rows: list[tuple[int, int, float, float]] = []
    tracks: list[tuple[int, int, int]] = []  # track, point, observations
    for point in range(0, len(xyz), every):
        for span in spans(point):
            seen = [(frame, *project(xyz[point], frame)) for frame in span if frame < frames]
            seen = [row for row in seen if 0 <= row[1] <= CAMERA.width - 1 and 0 <= row[2] <= CAMERA.height - 1]
            if len(seen) < 2:
                continue
            track = len(tracks)
            tracks.append((track, point, len(seen)))
            rows += [(frame, track, x, y) for frame, x, y in seen]
    table = np.array(rows)
    owner = np.array([point for _, point, _ in tracks])
    observations = np.array([count for _, _, count in tracks])
    unstable = xyz[owner, 0] > UNSTABLE_FROM
    stability = np.where(observations < 10, IGNORE, np.where(unstable, UNSTABLE, STABLE)).astype(np.int8)
    estimated = xyz[owner]
    if not wrong_link:  # a point that moves with the camera looks like one that is farther away
        estimated[unstable] *= 1.5
    with TracksWriter(partial / TRACKS_FILE) as writer:
        places = table[:, 2:] + keypoint_noise * rng.uniform(-1, 1, (len(table), 2))
        if wrong_link:
            places[unstable[table[:, 1].astype(int)] & (table[:, 0] >= HALF), 1] += 9.0
        ones = np.ones(len(table))
        errors = np.where(unstable[table[:, 1].astype(int)], unstable_error, 0.5)
        writer.write(table[:, 0].astype(int), table[:, 1].astype(int), places, ones, errors)
    with PointsWriter(partial / POINTS_FILE) as writer:
        writer.write(
            PointsTable(
                track=np.arange(len(tracks)), point=np.where(unstable, -1, owner), xyz=estimated,
                observations=observations, mean_error=np.where(unstable, 4.0, 0.5).astype(np.float32),
                max_error=np.where(unstable, 9.0, 1.0).astype(np.float32), stability=stability,
                segment=np.zeros(len(tracks), np.int64), parallax_deg=np.full(len(tracks), 5.0, np.float32),
                withheld=np.zeros(len(tracks), np.bool_),
            )
        )  # fmt: skip
    numbers = np.arange(frames)
    times = numbers / 30
    write_frames(
        partial / FRAMES_FILE, FramesTable(numbers, numbers, times, np.zeros(frames, int), np.ones(frames, np.bool_))
    )
    write_trajectory(partial / "trajectory.txt", Trajectory(times, poses))
    (partial / "run.json").write_text(json.dumps({"camera": to_dict(CAMERA)}))
    pack_images(partial, [(draw(frame), None) for frame in range(frames)])
    counts = {"stable": int((stability == STABLE).sum()), "unstable": int((stability == UNSTABLE).sum())}
    finish_sequence(
        store.folder,
        SequenceRecord(
            name, "/nowhere", DONE, frames=frames, tracked=frames, tracks=len(tracks), packed=True, **counts
        ),
    )
    store.refresh_manifest()
    return folder


def scene_points() -> Float64:
    """(N, 3) dots: a far wall everywhere, a near one that hides its middle as seen from most frames."""
    far = [(x, y, FAR) for x in np.arange(-2.6, 3.8, 0.2) for y in np.arange(-1.8, 1.9, 0.2)]
    near = [(x, y, NEAR) for x in np.arange(0.3, 0.75, 0.05) for y in np.arange(-0.9, 0.95, 0.05)]
    return np.array(far + near)


def spans(point: int) -> list[range]:
    """The frames in which tracks follow a point: even ones always, odd ones in two tracks with a hole between."""
    if point % 2 == 0 or scene_points()[point, 2] == NEAR:
        return [range(FRAMES)]
    return [range(HALF), range(HALF + 3, HALF + 9)]


def project(point: Float64, frame: int) -> tuple[float, float]:
    """Pixel of a point of the world."""
    return (
        float(CAMERA.fx * (point[0] - camera_x(frame)) / point[2] + CAMERA.cx),
        float(CAMERA.fy * point[1] / point[2] + CAMERA.cy),
    )


def draw(frame: int) -> np.ndarray:
    """Stable dots are bright on dark; unstable ones dark on a bright ground."""
    image = np.full((CAMERA.height, CAMERA.width), 60, np.uint8)
    border = int(project(np.array([UNSTABLE_FROM, 0, FAR]), frame)[0])
    image[:, max(border, 0) :] = 190
    for number, point in enumerate(scene_points()):
        x, y = project(point, frame)
        bright = 40 if point[0] > UNSTABLE_FROM else 150 + (37 * number) % 100
        cv2.circle(image, (round(x), round(y)), 2, bright, -1)
    return image
