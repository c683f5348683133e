"""A COLMAP project: `images` and a model of them in `sparse/0` or `sparse`, as structure from motion and Gaussian
splatting leave it. The model gives the camera and, up to scale, the true poses; images that it lacks have none.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.geometry.colmap_model import ColmapModel, is_colmap_model, read_colmap_model
from improvo.geometry.se3 import inverse
from improvo.sequences.base import SequenceSettings
from improvo.sequences.image_folder import ImageFolder
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
            self.calibration = model.calibration
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


def _poses_of(model: ColmapModel, files: list[Path]) -> Float64:
    """World-from-camera (N, 4, 4) of image files, NaN where the model has none."""
    pose_of = {Path(name).name: pose for name, pose in zip(model.names, inverse(model.cam_from_world), strict=True)}
    unknown = np.full((4, 4), np.nan)
    return np.stack([pose_of.get(file.name, unknown) for file in files])
