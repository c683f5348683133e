"""A run as COLMAP's text model, which COLMAP, pycolmap and most reconstruction tools open.

COLMAP puts the centre of the top-left pixel at (0.5, 0.5); pixels and principal point move by half a pixel.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from improvo.export.model import Model, image_name
from improvo.files import write_text
from improvo.geometry.camera import Camera
from improvo.geometry.se3 import quat_xyzw_from_rotation
from improvo.types import UInt8


def write_colmap(model: Model, camera: Camera, folder: Path, colours: UInt8 | None = None) -> None:
    """Write `cameras.txt`, `images.txt` and `points3D.txt`.

    Args:
        model: the segment.
        camera: pinhole.
        folder: made if need be.
        colours: (P, 3) RGB of the points; by default those of the map.
    """
    write_text(folder / "cameras.txt", _camera(camera))
    order = np.lexsort((model.point, model.frame))  # observations by image; the place in the image is POINT2D_IDX
    bounds = np.searchsorted(model.frame[order], np.arange(len(model.frames) + 1))
    place = np.empty(len(order), np.int64)
    for row in range(len(model.frames)):
        place[order[bounds[row] : bounds[row + 1]]] = np.arange(bounds[row + 1] - bounds[row])
    write_text(folder / "images.txt", _images(model, order, bounds))
    write_text(folder / "points3D.txt", _points(model, place, colours))


def _camera(camera: Camera) -> str:
    numbers = (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5)
    parameters = " ".join(repr(float(value)) for value in numbers)
    return f"# CAMERA_ID MODEL WIDTH HEIGHT fx fy cx cy\n1 PINHOLE {camera.width} {camera.height} {parameters}\n"


def _images(model: Model, order: np.ndarray, bounds: np.ndarray) -> str:
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then X Y POINT3D_ID of each observation\n"]
    for row, frame in enumerate(model.frames.tolist()):
        pose = model.cam_from_world[row]
        x, y, z, w = (float(value) for value in quat_xyzw_from_rotation(pose[:3, :3]))
        numbers = " ".join(repr(value) for value in (w, x, y, z, *pose[:3, 3].tolist()))
        lines.append(f"{row + 1} {numbers} 1 {image_name(frame)}\n")
        rows = order[bounds[row] : bounds[row + 1]]
        pixels, points = (model.keypoints[rows] + 0.5).tolist(), (model.point[rows] + 1).tolist()
        lines.append(" ".join(f"{u!r} {v!r} {p}" for (u, v), p in zip(pixels, points, strict=True)) + "\n")
    return "".join(lines)


def _points(model: Model, place: np.ndarray, colours: UInt8 | None) -> str:
    lines = ["# POINT3D_ID X Y Z R G B ERROR, then IMAGE_ID POINT2D_IDX of each observation\n"]
    errors = model.point_errors().tolist()
    shades = (model.rgb if colours is None else colours).tolist()
    bounds = np.searchsorted(model.point, np.arange(len(model.xyz) + 1))
    for number, xyz in enumerate(model.xyz.tolist()):
        rows = slice(bounds[number], bounds[number + 1])
        track = " ".join(
            f"{image + 1} {at}" for image, at in zip(model.frame[rows].tolist(), place[rows].tolist(), strict=True)
        )
        where, shade = " ".join(repr(value) for value in xyz), " ".join(map(str, shades[number]))
        lines.append(f"{number + 1} {where} {shade} {errors[number]!r} {track}\n")
    return "".join(lines)
