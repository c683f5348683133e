"""improvo: self-improving visual odometry (DeTone, Malisiewicz, Rabinovich 2018), and what lies beyond it.

The API is as short as the paper::

    sequence = improvo.open_sequence("video.mp4", camera="camera.yaml")
    frontend = improvo.load_frontend("superpoint-vo")
    with improvo.VisualOdometry(frontend, sequence.camera) as odometry:
        for frame in sequence:
            odometry.track(frame)
    print(odometry.trajectory.camera_centers, odometry.map.xyz)
"""

from __future__ import annotations

import importlib
import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from improvo.depth.run_settings import DenseRunSettings
    from improvo.errors import ConfigError, ImprovoError, InputError, MissingExtraError, OutputError
    from improvo.evaluation.settings import PoseSettings, TrajectorySettings
    from improvo.frontend import Frontend
    from improvo.frontend.registry import load_frontend
    from improvo.frontend.settings import FrontendSettings, NetworkOptions
    from improvo.geometry.camera import Camera
    from improvo.improvement.settings import ImproveSettings
    from improvo.odometry.run.run_folder import RunFolder
    from improvo.odometry.run_settings import LabelRunSettings, RunSettings
    from improvo.odometry.settings import OdometrySettings
    from improvo.odometry.visual_odometry import TrackedFrame, VisualOdometry
    from improvo.presets import preset
    from improvo.self_calibration.settings import SelfCalibrationSettings
    from improvo.sequences import Sequence, SequenceSettings, open_sequence
    from improvo.stability.rule import label_stability
    from improvo.stability.settings import LabelSettings
    from improvo.tracking.matching import mutual_nearest_neighbours as match
    from improvo.training.settings import OdometryTrainingSettings
    from improvo.types import Features, Frame, SparseMap, Tracks, Trajectory
    from improvo.verbs import evaluate_pose, evaluate_trajectory, find_camera, improve, label, run, train_odometry

__version__ = "0.1.0"

# public name -> module, and the name there where it is another; the imports above say the same to type checkers
_PUBLIC = {
    # nouns
    "Sequence": "improvo.sequences",
    "Frame": "improvo.types",
    "Camera": "improvo.geometry.camera",
    "Frontend": "improvo.frontend",
    "Features": "improvo.types",
    "Tracks": "improvo.types",
    "VisualOdometry": "improvo.odometry.visual_odometry",
    "TrackedFrame": "improvo.odometry.visual_odometry",
    "Trajectory": "improvo.types",
    "SparseMap": "improvo.types",
    "RunFolder": "improvo.odometry.run.run_folder",
    # verbs
    "open_sequence": "improvo.sequences",
    "load_frontend": "improvo.frontend.registry",
    "match": "improvo.tracking.matching:mutual_nearest_neighbours",
    "label_stability": "improvo.stability.rule",
    "find_camera": "improvo.verbs",
    "run": "improvo.verbs",
    "label": "improvo.verbs",
    "train_odometry": "improvo.verbs",
    "improve": "improvo.verbs",
    "evaluate_pose": "improvo.verbs",
    "evaluate_trajectory": "improvo.verbs",
    # settings
    "preset": "improvo.presets",
    "SequenceSettings": "improvo.sequences",
    "FrontendSettings": "improvo.frontend.settings",
    "NetworkOptions": "improvo.frontend.settings",
    "OdometrySettings": "improvo.odometry.settings",
    "LabelSettings": "improvo.stability.settings",
    "RunSettings": "improvo.odometry.run_settings",
    "DenseRunSettings": "improvo.depth.run_settings",
    "LabelRunSettings": "improvo.odometry.run_settings",
    "OdometryTrainingSettings": "improvo.training.settings",
    "ImproveSettings": "improvo.improvement.settings",
    "PoseSettings": "improvo.evaluation.settings",
    "SelfCalibrationSettings": "improvo.self_calibration.settings",
    "TrajectorySettings": "improvo.evaluation.settings",
    # errors
    "ImprovoError": "improvo.errors",
    "InputError": "improvo.errors",
    "OutputError": "improvo.errors",
    "ConfigError": "improvo.errors",
    "MissingExtraError": "improvo.errors",
}

__all__ = [
    "Camera",
    "ConfigError",
    "DenseRunSettings",
    "Features",
    "Frame",
    "Frontend",
    "FrontendSettings",
    "ImproveSettings",
    "ImprovoError",
    "InputError",
    "LabelRunSettings",
    "LabelSettings",
    "MissingExtraError",
    "NetworkOptions",
    "OdometrySettings",
    "OdometryTrainingSettings",
    "OutputError",
    "PoseSettings",
    "RunFolder",
    "RunSettings",
    "SelfCalibrationSettings",
    "Sequence",
    "SequenceSettings",
    "SparseMap",
    "TrackedFrame",
    "Tracks",
    "Trajectory",
    "TrajectorySettings",
    "VisualOdometry",
    "__version__",
    "evaluate_pose",
    "evaluate_trajectory",
    "find_camera",
    "improve",
    "label",
    "label_stability",
    "load_frontend",
    "match",
    "open_sequence",
    "preset",
    "run",
    "train_odometry",
]

logging.getLogger(__name__).addHandler(logging.NullHandler())

if not TYPE_CHECKING:  # type checkers see the imports above, and call other names unknown

    def __getattr__(name: str) -> object:
        """Import public names when they are first used, so that `import improvo` costs nothing."""
        if name not in _PUBLIC:
            raise AttributeError(f"module 'improvo' has no attribute {name!r}")
        module, _, attribute = _PUBLIC[name].partition(":")
        found = getattr(importlib.import_module(module), attribute or name)
        globals()[name] = found
        return found

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
