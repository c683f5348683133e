"""Encoders of recordings, written from the published descriptions of the formats, for the tests of `sequences`."""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from improvo.geometry.camera import Camera
from improvo.geometry.camera_files import calibration_yaml
from improvo.geometry.se3 import inverse, quat_xyzw_from_rotation
from improvo.simulation.tum_writer import TumRgbdWriter
from improvo.types import Float64, UInt8

_CV_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Scene:
    """One recording to be written in many formats: times in whole milliseconds, depth in whole millimetres."""

    camera: Camera
    times: Float64
    images: list[UInt8]
    depths: list[np.ndarray]
    poses: Float64

    def __len__(self) -> int:
        return len(self.times)

    def millimetres(self, i: int) -> np.ndarray:
        return np.rint(np.nan_to_num(self.depths[i].astype(np.float64)) * 1000).astype(np.uint16)


def png(image: np.ndarray) -> bytes:
    encoded, data = cv2.imencode(".png", image)
    assert encoded
    return data.tobytes()


def write_tum(folder: Path, scene: Scene) -> Path:
    with TumRgbdWriter(folder, scene.camera, depth_scale=1000.0) as writer:
        for i in range(len(scene)):
            writer.add(float(scene.times[i]), scene.images[i], scene.depths[i], scene.poses[i])
    return folder


def write_image_folder(folder: Path, scene: Scene) -> Path:
    (folder / "images").mkdir(parents=True)
    for i, image in enumerate(scene.images):
        (folder / "images" / f"{i:06d}.png").write_bytes(png(image))
    (folder / "camera.yaml").write_text(calibration_yaml(scene.camera))
    (folder / "times.txt").write_text("".join(f"{time!r}\n" for time in scene.times.tolist()))
    return folder


def write_seven_scenes(folder: Path, scene: Scene, fps: float) -> Path:
    folder.mkdir(parents=True)
    for i, image in enumerate(scene.images):
        (folder / f"frame-{i:06d}.color.png").write_bytes(png(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)))
        (folder / f"frame-{i:06d}.depth.png").write_bytes(png(scene.millimetres(i)))
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", scene.poses[i])
    (folder / "camera.yaml").write_text(calibration_yaml(scene.camera, fps=fps))
    return folder


def write_kitti(folder: Path, scene: Scene) -> Path:
    (folder / "image_0").mkdir(parents=True)
    for i, image in enumerate(scene.images):
        (folder / "image_0" / f"{i:06d}.png").write_bytes(png(image))
    projection = np.concatenate([scene.camera.K, np.zeros((3, 1))], axis=1)
    (folder / "calib.txt").write_text(f"P0: {' '.join(f'{value:.17e}' for value in projection.ravel())}\n")
    (folder / "times.txt").write_text("".join(f"{time:.17e}\n" for time in scene.times))
    np.savetxt(folder / "poses.txt", scene.poses[:, :3].reshape(-1, 12))
    return folder


def write_euroc(folder: Path, scene: Scene, body_from_cam: Float64, camera: str = "cam0") -> Path:
    base = folder / "mav0"
    (base / camera / "data").mkdir(parents=True)
    stamps = np.rint(scene.times * 1e9).astype(np.int64)
    rows = ["#timestamp [ns],filename"]
    for stamp, image in zip(stamps, scene.images, strict=True):
        (base / camera / "data" / f"{stamp}.png").write_bytes(png(image))
        rows.append(f"{stamp},{stamp}.png")
    (base / camera / "data.csv").write_text("\r\n".join(rows) + "\r\n")
    c = scene.camera
    matrix = ", ".join(repr(float(value)) for value in body_from_cam.ravel())
    (base / camera / "sensor.yaml").write_text(
        f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{matrix}]\nrate_hz: 20\n"
        f"resolution: [{c.width}, {c.height}]\ncamera_model: pinhole\n"
        f"intrinsics: [{c.fx!r}, {c.fy!r}, {c.cx!r}, {c.cy!r}] #fu, fv, cu, cv\n"
        f"distortion_model: radial-tangential\ndistortion_coefficients: {list(c.distortion) or [0.0] * 4}\n"
    )
    truth = base / "state_groundtruth_estimate0"
    truth.mkdir(exist_ok=True)
    lines = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v"]
    for stamp, world_from_body in zip(stamps, scene.poses @ inverse(body_from_cam), strict=True):
        x, y, z, w = quat_xyzw_from_rotation(world_from_body[:3, :3])
        numbers = [*world_from_body[:3, 3], w, x, y, z, 0.0]
        lines.append(",".join([str(stamp), *(repr(float(value)) for value in numbers)]))
    (truth / "data.csv").write_text("\n".join(lines))
    (truth / "sensor.yaml").write_text(
        "sensor_type: visual-inertial\nT_BS:\n  data: " + str(np.eye(4).ravel().tolist())
    )
    return folder


def write_sens(
    path: Path,
    scene: Scene,
    compression: str = "png",
    depth_camera: Camera | None = None,
    colour_from_depth: Float64 | None = None,
    depths: list[np.ndarray] | None = None,
    claimed: int | None = None,
) -> Path:
    """Version 4, little-endian; `depths` are 16-bit images of the depth camera, in millimetres."""
    path.parent.mkdir(parents=True, exist_ok=True)
    depth_camera = depth_camera or scene.camera

    def intrinsic(camera: Camera) -> Float64:
        matrix = np.eye(4)
        matrix[:3, :3] = camera.K
        return matrix

    extrinsic_depth = np.eye(4) if colour_from_depth is None else colour_from_depth
    with path.open("wb") as file:
        file.write(struct.pack("<IQ", 4, 15) + b"StructureSensor")
        for matrix in (intrinsic(scene.camera), np.eye(4), intrinsic(depth_camera), extrinsic_depth):
            file.write(matrix.astype("<f4").tobytes())
        file.write(struct.pack("<ii", {"raw": 0, "png": 1, "jpeg": 2}[compression], 1))
        file.write(struct.pack("<4I", scene.camera.width, scene.camera.height, depth_camera.width, depth_camera.height))
        file.write(struct.pack("<fQ", 1000.0, len(scene) if claimed is None else claimed))
        for i, image in enumerate(scene.images):
            colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
            if compression == "raw":
                data = cv2.cvtColor(colour, cv2.COLOR_BGR2RGB).tobytes()
            else:
                data = cv2.imencode(f".{compression}", colour)[1].tobytes()
            depth = zlib.compress((scene.millimetres(i) if depths is None else depths[i]).astype("<u2").tobytes())
            stamp = round(scene.times[i] * 1e6)
            file.write(scene.poses[i].astype("<f4").tobytes())
            file.write(struct.pack("<4Q", stamp, stamp, len(data), len(depth)) + data + depth)
        file.write(struct.pack("<Q", 0))
    return path


def write_scannet_folder(folder: Path, scene: Scene) -> Path:
    for name in ("color", "depth", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    matrix = np.eye(4)
    matrix[:3, :3] = scene.camera.K
    for name in ("intrinsic_color", "intrinsic_depth"):
        np.savetxt(folder / "intrinsic" / f"{name}.txt", matrix)
    for name in ("extrinsic_color", "extrinsic_depth"):
        np.savetxt(folder / "intrinsic" / f"{name}.txt", np.eye(4))
    for i, image in enumerate(scene.images):
        (folder / "color" / f"{i}.png").write_bytes(png(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)))
        (folder / "depth" / f"{i}.png").write_bytes(png(scene.millimetres(i)))
        np.savetxt(folder / "pose" / f"{i}.txt", scene.poses[i])
    return folder


def write_transforms(folder: Path, scene: Scene) -> Path:
    """Nerfstudio: principal point from the pixel corner, OpenGL cameras."""
    (folder / "images").mkdir(parents=True)
    (folder / "depth").mkdir()
    c = scene.camera
    frames = []
    for i, image in enumerate(scene.images):
        (folder / "images" / f"frame_{i:05d}.png").write_bytes(png(image))
        (folder / "depth" / f"frame_{i:05d}.png").write_bytes(png(scene.millimetres(i)))
        frames.append(
            {
                "file_path": f"images/frame_{i:05d}.png",
                "depth_file_path": f"depth/frame_{i:05d}.png",
                "transform_matrix": (scene.poses[i] @ _CV_FROM_GL).tolist(),
            }
        )
    content = {"camera_model": "OPENCV", "w": c.width, "h": c.height, "fl_x": c.fx, "fl_y": c.fy}
    content |= {"cx": c.cx + 0.5, "cy": c.cy + 0.5, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "frames": frames[::-1]}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def write_polycam(folder: Path, scene: Scene) -> Path:
    for name in ("images", "cameras", "depth"):
        (folder / "keyframes" / name).mkdir(parents=True)
    c = scene.camera
    for i, image in enumerate(scene.images):
        stamp = round(scene.times[i] * 1e6)
        (folder / "keyframes" / "images" / f"{stamp}.png").write_bytes(png(image))
        (folder / "keyframes" / "depth" / f"{stamp}.png").write_bytes(png(scene.millimetres(i)))
        pose = scene.poses[i] @ _CV_FROM_GL
        entry: dict[str, float] = {f"t_{r}{k}": float(pose[r, k]) for r in range(3) for k in range(4)}
        entry |= {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "width": c.width, "height": c.height}
        entry |= {"timestamp": stamp, "blur_score": 100.0}
        (folder / "keyframes" / "cameras" / f"{stamp}.json").write_text(json.dumps(entry))
    return folder


def write_colmap_project(folder: Path, scene: Scene, model: str = "sparse/0") -> Path:
    """Images and a model of them as text; its pixels count from the corner, its poses are camera-from-world."""
    (folder / "images").mkdir(parents=True)
    (folder / model).mkdir(parents=True)
    c = scene.camera
    size = f"{c.width} {c.height}"
    (folder / model / "cameras.txt").write_text(f"3 PINHOLE {size} {c.fx} {c.fy} {c.cx + 0.5} {c.cy + 0.5}\n")
    lines = []
    for i, (image, pose) in enumerate(zip(scene.images, np.linalg.inv(scene.poses), strict=True)):
        (folder / "images" / f"{i:04d}.png").write_bytes(png(image))
        x, y, z, w = quat_xyzw_from_rotation(pose[:3, :3]).tolist()
        motion = " ".join(repr(float(value)) for value in (w, x, y, z, *pose[:3, 3]))
        lines += [f"{i + 1} {motion} 3 {i:04d}.png", ""]
    (folder / model / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def record3d_metadata(scene: Scene) -> dict[str, object]:
    c = scene.camera
    poses = scene.poses @ _CV_FROM_GL
    rows = [[*quat_xyzw_from_rotation(pose[:3, :3]).tolist(), *pose[:3, 3].tolist()] for pose in poses]
    return {
        "w": c.width,
        "h": c.height,
        "dw": 8,
        "dh": 6,
        "fps": 30,
        "K": [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1],
        "perFrameIntrinsicCoeffs": [[c.fx, c.fy, c.cx, c.cy]] * len(scene),
        "frameTimestamps": scene.times.tolist(),
        "poses": rows,
    }


def write_r3d(path: Path, scene: Scene) -> Path:
    import zipfile

    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(record3d_metadata(scene)))
        for i, image in enumerate(scene.images):
            archive.writestr(f"rgbd/{i}.png", png(image))
    return path


def write_icl(folder: Path, scene: Scene) -> Path:
    """Frames 0, 1, ... with poses from frame 1 on, of a camera whose y axis points up."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    associations, truth = [], []
    for i, image in enumerate(scene.images):
        (folder / "rgb" / f"{i}.png").write_bytes(png(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)))
        depth = np.rint(np.nan_to_num(scene.depths[i].astype(np.float64)) * 5000).astype(np.uint16)
        (folder / "depth" / f"{i}.png").write_bytes(png(depth))
        associations.append(f"{i} depth/{i}.png {i} rgb/{i}.png")
        pose = flip @ scene.poses[i] @ flip
        if i > 0:
            numbers = [*pose[:3, 3], *quat_xyzw_from_rotation(pose[:3, :3])]
            truth.append(" ".join([str(i), *(repr(float(value)) for value in numbers)]))
    (folder / "associations.txt").write_text("\n".join(associations))
    (folder / "livingRoom2n.gt.freiburg").write_text("\n".join(truth))
    return folder
