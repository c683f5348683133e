"""ScanNet as exported to files: `color`, `depth`, `pose`, `intrinsic`; or `frame-000000.color.jpg` with `_info.txt`.

The second layout is that of 7-Scenes with a calibration; BundleFusion's recordings have it too. Depth is in millimetres
unless `_info.txt` says otherwise. Neither has time stamps: 30 frames per second.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera import Camera
from improvo.geometry.camera_files import Calibration, folder_calibration
from improvo.geometry.camera_files.calibration import checked
from improvo.geometry.text_files import decoded, read_text
from improvo.geometry.trajectory_files import clean_poses
from improvo.sequences.base import SequenceSettings
from improvo.sequences.image_files import ImageFiles, ImageFilesRecording
from improvo.sequences.images import list_images, read_depth
from improvo.sequences.rates import frame_rate
from improvo.sequences.registration import intrinsics_of, register_depth, relative_extrinsics
from improvo.types import Float32, Float64, Trajectory
from improvo.untrusted.names import number_of
from improvo.untrusted.numbers import numbers
from improvo.untrusted.paths import check_is_file

DEPTH_SCALE = 1000.0
FPS = 30.0


class ScanNetFolder(ImageFilesRecording):
    """An exported scene."""

    format = "scannet"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        self._scale = DEPTH_SCALE
        self._depth_intrinsics: tuple[float, float, float, float] | None = None
        self._extrinsics = (np.eye(4), np.eye(4))
        info = _info_file(path)
        files = _numbered(path) if info is not None else list_images(path / "color")
        self._images = ImageFiles(files, path)
        self.notes = tuple(self._images.notes)
        if not files:
            raise InputError(f"{path}: has no colour images; export the scene again")
        if info is not None:
            self._read_info(info)
            stems = [file.name.split(".")[0] for file in files]
            self._depth = [_first(path / f"{stem}.depth.png", path / f"{stem}.depth.pgm") for stem in stems]
            poses_files = [path / f"{stem}.pose.txt" for stem in stems]
            numbers = np.array([int(stem.split("-")[1]) for stem in stems], np.float64)
        else:
            self._read_intrinsics(path / "intrinsic")
            stems = [file.stem for file in files]
            self._depth = [path / "depth" / f"{stem}.png" for stem in stems]
            poses_files = [path / "pose" / f"{stem}.txt" for stem in stems]
            numbers = np.array(
                [row if number_of(stem) is None else number_of(stem) for row, stem in enumerate(stems)], np.float64
            )
        published = self.calibration
        self.calibration = self.own_calibration(lambda: folder_calibration(path), lambda: published)
        if self.calibration is not None:
            self.calibration_error = None
        given = settings.fps or settings.camera or (self.calibration and self.calibration.fps)
        self.times = (numbers - numbers[0]) / (frame_rate(self.calibration, settings, path)[0] if given else FPS)
        if len(self.times) > 1 and not (np.diff(self.times) > 0).all():
            raise InputError(f"{path}: two images have the same number; remove one")
        matrices = np.stack([read_matrix(file) for file in poses_files])
        poses, not_finite, not_rigid = clean_poses(matrices)
        bad = [r for r in np.union1d(not_finite, not_rigid).tolist() if poses_files[r].is_file()]
        if bad:
            named = ", ".join(poses_files[row].name for row in bad[:5]) + (", ..." if len(bad) > 5 else "")
            self.notes = (*self.notes, f"{path}: {len(bad)} pose files hold no rigid pose ({named})")
        if np.isfinite(poses).any():
            self.ground_truth = Trajectory(self.times, poses @ self._extrinsics[0])

    @classmethod
    def recognises(cls, path: Path) -> bool:
        if not path.is_dir():
            return False
        exported = (path / "color").is_dir() and ((path / "intrinsic").is_dir() or (path / "pose").is_dir())
        return exported or _info_file(path) is not None

    def depth(self, index: int) -> Float32 | None:
        file = self._depth[index]
        if file is None or not file.is_file():
            return None
        depth = read_depth(file, self._scale)
        if self.calibration is None or self._depth_intrinsics is None or self.calibration.size is None:
            return depth
        camera = self.calibration.camera(*self.calibration.size)
        depth_camera = Camera(depth.shape[1], depth.shape[0], *self._depth_intrinsics)
        return register_depth(depth, depth_camera, camera.pinhole(), self._extrinsics[1])

    def _read_intrinsics(self, folder: Path) -> None:
        """`intrinsic_color.txt` and its three companions."""
        colour = read_matrix(folder / "intrinsic_color.txt")
        if np.isfinite(colour).all():
            height, width = self._images.read(0).shape[:2]
            published = Calibration(str(folder / "intrinsic_color.txt"), intrinsics_of(colour), size=(width, height))
            self.calibration = self.own_calibration(lambda: checked(published))
        depth = read_matrix(folder / "intrinsic_depth.txt")
        if np.isfinite(depth).all() and min(depth[0, 0], depth[1, 1]) > 0:
            self._depth_intrinsics = intrinsics_of(depth)
        extrinsics = [read_matrix(folder / f"extrinsic_{name}.txt") for name in ("color", "depth")]
        self._extrinsics = relative_extrinsics(*extrinsics)

    def _read_info(self, info: Path) -> None:
        """`name = values` lines, as the C++ exporter writes them."""
        lines = read_text(info, "a description of a scene").splitlines()
        values = {name.strip(): text.split() for name, _, text in (line.partition("=") for line in lines)}
        colour = numbers(values.get("m_calibrationColorIntrinsic"), 16).reshape(4, 4)
        width, height = (_number(values.get(f"m_color{side}"), 0) for side in ("Width", "Height"))
        size = (int(width), int(height)) if width >= 1 and height >= 1 else None

        def published() -> Calibration:
            if not np.isfinite(colour).all():
                raise InputError(f"{info}: has no m_calibrationColorIntrinsic with 16 numbers; export the scene again")
            return checked(Calibration(str(info), intrinsics_of(colour), size=size))

        self.calibration = self.own_calibration(published)
        depth = numbers(values.get("m_calibrationDepthIntrinsic"), 16).reshape(4, 4)
        if np.isfinite(depth).all() and min(depth[0, 0], depth[1, 1]) > 0:
            self._depth_intrinsics = intrinsics_of(depth)
        extrinsics = [
            numbers(values.get(f"m_calibration{name}Extrinsic"), 16).reshape(4, 4) for name in ("Color", "Depth")
        ]
        self._extrinsics = relative_extrinsics(*extrinsics)
        scale = _number(values.get("m_depthShift"), DEPTH_SCALE)
        self._scale = scale if scale > 0 else DEPTH_SCALE


def read_matrix(path: Path) -> Float64:
    """(4, 4) from a text file, NaN if there is none or it holds anything else."""
    try:
        fields = decoded(check_is_file(path).read_bytes()).replace(",", " ").split()
    except (OSError, UnicodeDecodeError):
        fields = []
    return numbers(fields, 16).reshape(4, 4)


def _number(fields: list[str] | None, default: float) -> float:
    try:
        value = float((fields or [])[0])
    except (IndexError, ValueError):
        return default
    return value if np.isfinite(value) else default


def _info_file(path: Path) -> Path | None:
    for name in ("_info.txt", "info.txt"):
        if (path / name).is_file() and next(path.glob("frame-*.color.*"), None) is not None:
            return path / name
    return None


def _numbered(path: Path) -> list[Path]:
    pictures = [file for file in list_images(path) if file.name.startswith("frame-") and ".color." in file.name]
    return [file for file in pictures if number_of(file.name.split(".")[0][6:]) is not None]


def _first(*files: Path) -> Path | None:
    return next((file for file in files if file.is_file()), None)
