"""A run as Nerfstudio reads it: `transforms.json`, images and a coloured point cloud to start from."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from improvo.export.model import Model, image_name
from improvo.files import write_json, written_atomically
from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.types import UInt8

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # y up, looking along -z
_POINT_CLOUD = "sparse_pc.ply"


def write_nerfstudio(model: Model, camera: Camera, folder: Path, colours: UInt8) -> None:
    """Write `transforms.json` and the point cloud into a folder whose `images/` holds the frames.

    Nerfstudio counts pixels from the corner of the top-left one, half a pixel before its centre.
    """
    world_from_cam = se3.inverse(model.cam_from_world) @ _OPENGL_FROM_OPENCV
    _write_point_cloud(model, colours, folder / _POINT_CLOUD)
    write_json(
        folder / "transforms.json",
        {
            "camera_model": "OPENCV",
            "w": camera.width,
            "h": camera.height,
            "fl_x": camera.fx,
            "fl_y": camera.fy,
            "cx": camera.cx + 0.5,
            "cy": camera.cy + 0.5,
            "k1": 0.0,
            "k2": 0.0,
            "p1": 0.0,
            "p2": 0.0,
            "ply_file_path": _POINT_CLOUD,
            "frames": [
                {"file_path": f"images/{image_name(frame)}", "transform_matrix": pose.tolist()}
                for frame, pose in zip(model.frames.tolist(), world_from_cam, strict=True)
            ],
        },
    )


def _write_point_cloud(model: Model, colours: UInt8, path: Path) -> None:
    vertices = np.zeros(
        len(model.xyz), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    )
    for name, column in zip("xyz", model.xyz.T, strict=True):
        vertices[name] = column
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colours[:, channel]
    kinds = "".join(f"property float {name}\n" for name in "xyz")
    shades = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{kinds}{shades}end_header\n"
    with written_atomically(path) as temporary:
        temporary.write_bytes(header.encode() + vertices.tobytes())
