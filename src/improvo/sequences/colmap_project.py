"""A COLMAP project: `images` and a model of them in `sparse/0` or `sparse`, as structure from motion and Gaussian
splatting leave it. The model gives the camera and, up to scale, the true poses; images that it lacks have none.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera_files import Calibration
from improvo.geometry.colmap_model import ColmapModel, is_colmap_model, read_colmap_model
from improvo.geometry.se3 import inverse
from improvo.sequences.base import SequenceSettings
from improvo.sequences.image_folder import ImageFolder
from improvo.sequences.varying_camera import median_calibration
from improvo.types import Float64, Int64, Trajectory

_MODELS = ("sparse/0", "sparse", "colmap/sparse/0")


class ColmapProject(ImageFolder):
    """An image folder with a model beside it; what lies beside the images otherwise comes before the model."""

    format = "colmap"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self._poses: Float64 | None = None  # (N, 4, 4) of the model, NaN where it lacks the image
        folder = _model_of(path)
        if folder is None:
            raise InputError(f"{path}: has no COLMAP model in {', '.join(_MODELS)}")
        super().__init__(path, settings)
        if self.calibration is not None and self.ground_truth is not None:
            return
        try:
            model = read_colmap_model(folder)
        except InputError as error:
            self.notes = (*self.notes, f"its COLMAP model is left out ({error})")
            return
        if self.calibration is None and self.calibration_error is None:
            notes = list(self.notes)
            self.calibration = self.own_calibration(lambda: _common_camera(model, notes))
            self.notes = tuple(notes)
        if self.ground_truth is None:
            self._poses = _poses_of(model, self._images.files)
            self.ground_truth = Trajectory(self.times, self._poses)
            found = int(self.ground_truth.valid.sum())
            self.notes = (*self.notes, f"{folder}: gives the true poses of {found} of {len(self.times)} images")

    def true_poses(self, indices: Int64) -> Trajectory | None:
        """As it says; an image that the model lacks has no pose, whatever its neighbours have."""
        if self._poses is None:
            return super().true_poses(indices)
        return Trajectory(self.times[indices], self._poses[indices])

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return super().recognises(path) and _model_of(path) is not None


def _model_of(path: Path) -> Path | None:
    """The folder of the model of a project, or of its `images` folder."""
    homes = (path, path.parent) if path.name == "images" else (path,)
    return next((home / name for home in homes for name in _MODELS if is_colmap_model(home / name)), None)


def _common_camera(model: ColmapModel, notes: list[str]) -> Calibration:
    """One camera for all images: COLMAP gives each its own unless told otherwise, and then their median is taken.

    A line is added to `notes` where they differ by 1 %.

    Raises:
        InputError: they are of several sizes or kinds, and so hardly of one camera.
    """
    each = model.calibrations
    if len({(one.size, one.distortion_model, len(one.distortion)) for one in each}) > 1:
        return model.calibration  # says how many there are
    distortion = tuple(np.median([one.distortion for one in each], axis=0).tolist())
    rows = np.array([one.intrinsics for one in each])
    return median_calibration(str(model.folder), rows, distortion, each[0].distortion_model, each[0].size, notes)


def _poses_of(model: ColmapModel, files: list[Path]) -> Float64:
    """World-from-camera (N, 4, 4) of image files, NaN where the model has none."""
    pose_of = {Path(name).name: pose for name, pose in zip(model.names, inverse(model.cam_from_world), strict=True)}
    unknown = np.full((4, 4), np.nan)
    return np.stack([pose_of.get(file.name, unknown) for file in files])
