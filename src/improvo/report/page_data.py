"""What the interactive parts of a page draw: the 3D scene and the frames, packed as base64 in JSON."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from improvo.errors import InputError
from improvo.odometry.run.run_folder import RunFolder
from improvo.report.map_picture import LAST_POSES, map_colours, trusted_points
from improvo.report.overhead import overhead_axes, robust_limits
from improvo.report.palettes import Palette
from improvo.report.true_path import TruePath
from improvo.stability.rule import IGNORE
from improvo.types import Float64, UInt8

_MAX_POINTS = 40_000  # points of a layer; more make the page larger but not clearer
_JPEG_QUALITY = 55
_NO_ERROR = 255
_FLOW = 5  # frames behind each point
_JUMP_SHARE = 0.06  # of the image width; longer links are not drawn


def scene_data(run: RunFolder, palette: Palette, truth: TruePath | None = None) -> dict[str, Any]:
    """The 3D scene: layers of coloured points, poses, the true path, and where to look from first; z is up."""
    trajectory = run.trajectory
    axes = overhead_axes(trajectory.world_from_cam)
    scene_from_world = np.stack([axes.right, axes.forward, -axes.down])
    centres = trajectory.camera_centers @ scene_from_world.T
    map_rows = _some(trusted_points(run.map))
    map_points = run.map.xyz[map_rows] @ scene_from_world.T
    labelled = np.flatnonzero(
        (run.points.stability != IGNORE) & np.isfinite(run.points.xyz).all(axis=1) & (run.points.segment >= 0)
    )
    label_rows = _some(labelled)
    label_points = run.points.xyz[label_rows] @ scene_from_world.T
    low, high = robust_limits(centres[:, :2], map_points[:, :2])
    heights = np.concatenate([centres[:, 2], map_points[:, 2]])
    centre = [*((low + high) / 2).tolist(), float(np.median(heights))]
    camera_axes = trajectory.world_from_cam[:, :3, :3]  # columns: the camera's axes in the world
    rotated = np.einsum("ij,njk->nki", scene_from_world, camera_axes)  # (N, axis, scene coordinate)
    poses = np.concatenate([centres[:, None], rotated], axis=1).reshape(-1)
    return {
        "layers": {
            "map": _layer(map_points, map_colours(run.map)[map_rows]),
            "labels": _layer(label_points, palette.label_colours(run.points.stability[label_rows])),
        },
        "poses": _base64(poses.astype("<f4")),
        "truth": None if truth is None else _base64((truth.drawn() @ scene_from_world.T).astype("<f4")),
        "frame_indices": run.frame_indices.tolist(),
        "segments": trajectory.segment.tolist(),
        "doubted": (run.doubtful | run.uncertain).tolist(),
        "frames": run.frames,
        "last": min(LAST_POSES, max(len(trajectory) - 1, 0)),
        "centre": centre,
        "radius": float(np.linalg.norm(high - low) / 2),
        "half_width": run.camera.width / 2 / run.camera.fx,
        "half_height": run.camera.height / 2 / run.camera.fy,
        "ramp": palette.ramp_strip(64).reshape(-1).tolist(),
    }


def frames_data(
    run: RunFolder, frames: list[int], palette: Palette, width: int, old: int = 30, large_error: float = 3.0
) -> tuple[dict[str, Any], Float64]:
    """The frames of the slider with their tracks, and the mean brightness (N,) of each in grey values.

    Frames that can no longer be read from the recording are left out.

    Args:
        frames: which of the run's.
        palette: of what is drawn over them.
        width: of the pictures in pixels.
        old: age in frames of the last colour.
        large_error: pixels, of the last colour.

    Raises:
        InputError: the recording is not there any more.
    """
    import cv2

    assert len(run.sequence) > 0  # opened here, so that a missing recording raises an error instead of giving no frames
    shown, brightness = [], []
    for frame in frames:
        try:
            image = run.image(frame)
        except InputError:
            continue
        height = round(image.shape[0] * width / image.shape[1])
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        seen = run.observations(frame)
        shown.append(
            {
                "frame": frame,
                "jpeg": base64.b64encode(jpeg.tobytes()).decode(),
                "points": _base64(_packed_points(run, frame, old, large_error)),
                "caption": f"frame {frame} of {run.frames}: {int((seen.age > 0).sum())} tracks, "
                + (f"median error {np.nanmedian(seen.error):.2f} px" if np.isfinite(seen.error).any() else "no pose"),
            }
        )
        brightness.append(float(image.mean()))
    data = {
        "frames": shown,
        "width": run.camera.width,
        "parts": pixel_parts(run.camera.width, run.camera.height),
        "young": int(255 * 2 / old),  # ages are stored as shares of `old`
        "ramp": palette.ramp_strip(256).reshape(-1).tolist(),
        "labels": palette.label_colours(np.arange(3)).reshape(-1).tolist(),
    }
    return data, np.array(brightness)


def pixel_parts(width: int, height: int) -> int:
    """Into how many parts a pixel can be divided such that two bytes count those of the longer side."""
    return max(1, min(16, 65536 // max(width, height)))


def _packed_points(run: RunFolder, frame: int, old: int, large_error: float) -> NDArray[np.void]:
    """The tracks of a frame: where they are and were, in parts of a pixel, and age, error and label as bytes."""
    seen = run.observations(frame)
    row = np.dtype([("now", "<u2", 2), ("before", "<u2", 2), ("age", "u1"), ("error", "u1"), ("label", "u1")])
    packed = np.zeros(len(seen), row)
    before = seen.keypoints.copy()
    followed = np.ones(len(seen), np.bool_)
    for earlier_frame in range(frame - 1, max(frame - _FLOW, 0) - 1, -1):
        rows = run.rows_of(earlier_frame, seen.track)
        earlier = run.tracks.keypoints[rows].astype(np.float64)
        # where a link jumps, only the part after the jump is drawn
        followed &= (rows >= 0) & (np.linalg.norm(earlier - before, axis=1) < _JUMP_SHARE * run.camera.width)
        before[followed] = earlier[followed]
    parts = pixel_parts(run.camera.width, run.camera.height)
    packed["now"] = np.clip(np.round(seen.keypoints * parts), 0, 65535)
    packed["before"] = np.clip(np.round(before * parts), 0, 65535)
    packed["age"] = np.clip(seen.age / old * 255, 0, 255)
    error = np.clip(np.nan_to_num(seen.error) / large_error, 0, 1) * (_NO_ERROR - 1)
    packed["error"] = np.where(np.isfinite(seen.error), error, _NO_ERROR)
    packed["label"] = seen.stability
    return packed[np.argsort(seen.age, kind="stable")]


def per_frame(run: RunFolder, value: Callable[[NDArray[np.int64]], float]) -> Float64:
    """(frames,) of `value` on the rows of `run.tracks` that belong to each frame."""
    return np.array([value(run.rows_at(frame)) for frame in range(run.frames)])


def _layer(xyz: Float64, rgb: UInt8) -> dict[str, str]:
    return {"xyz": _base64(xyz.astype("<f4")), "rgb": _base64(rgb)}


def _some(rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """All rows, or as many as a page may have, spread evenly."""
    if len(rows) <= _MAX_POINTS:
        return rows
    return rows[np.linspace(0, len(rows) - 1, _MAX_POINTS).astype(np.int64)]


def _base64(array: NDArray[np.generic]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()
