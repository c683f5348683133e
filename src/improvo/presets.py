"""Presets: whole settings under a name, one registry for all commands.

`paper` is what the paper fixes and nothing else: the mode, unit depth, its objective and iterations, raw labels, pairs
uniform within 60 frames, the plain losses, OpenCV's solver. What it leaves open, such as the frontend and the weights
of the losses, stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from improvo.errors import ConfigError

if TYPE_CHECKING:
    from improvo.depth.run_settings import DenseRunSettings
    from improvo.evaluation.settings import PoseCommandSettings, VoCommandSettings
    from improvo.improvement.settings import ImproveSettings
    from improvo.odometry.run_settings import LabelRunSettings, RunSettings
    from improvo.training.settings import HomographiesSettings, OdometryTrainingSettings, ShapesSettings

T = TypeVar("T")
PAPER = "paper"


def preset(cls: type[T], name: str) -> T:
    """The settings of type `cls` that a name stands for.

    Args:
        cls: `RunSettings`, `LabelRunSettings`, `ImproveSettings`, `OdometryTrainingSettings`, ...
        name: `paper`.

    Raises:
        ConfigError: there is no such preset for these settings.
    """
    known = presets(cls.__name__)
    if name not in known:
        which = f"choose {', '.join(known)}" if known else "there is none for these settings"
        raise ConfigError(f"preset `{name}`: unknown; {which}")
    settings: T = known[name]()
    return settings


def presets(class_name: str) -> Mapping[str, Callable[[], Any]]:
    """The presets of a class of settings, by name; empty where it has none."""
    return _simulations() if class_name == "SimulationSettings" else _PRESETS.get(class_name, {})


def _paper_run() -> RunSettings:
    from improvo.odometry.run_settings import paper_run_settings

    return paper_run_settings()


def _paper_dense_run() -> DenseRunSettings:
    from improvo.depth.run_settings import DenseRunSettings
    from improvo.odometry.run_settings import paper_run_settings

    return paper_run_settings(DenseRunSettings())


def _paper_label() -> LabelRunSettings:
    from improvo.odometry.run_settings import LabelRunSettings, paper_run_settings

    return paper_run_settings(LabelRunSettings())


def _paper_shapes() -> ShapesSettings:
    from improvo.training.settings import DetectorLossSettings, ShapesSettings

    return ShapesSettings(detector=DetectorLossSettings(position_weight=0.0))


def _paper_homographies() -> HomographiesSettings:
    from improvo.training.settings import HINGE, DetectorLossSettings, HomographiesSettings

    plain = DetectorLossSettings(position_weight=0.0)
    return HomographiesSettings(detector=plain, descriptor_loss=HINGE, shapes=0)


def _paper_training() -> OdometryTrainingSettings:
    from improvo.training.settings import (
        HINGE,
        DetectorLossSettings,
        LandmarkSettings,
        OdometryTrainingSettings,
        PairSettings,
    )

    return OdometryTrainingSettings(
        descriptor_loss=HINGE,
        stability_balanced=False,
        detector=DetectorLossSettings(position_weight=0.0),
        pairs=PairSettings(largest_gap=60, wide_baselines=0.0, same_frame_share=0.0, least_points=0),
        landmarks=LandmarkSettings(
            shared=False, unseen=False, reprojected=False, unstable_median_error=0.0, unstable_largest_step=1.0
        ),
    )


def _paper_improve() -> ImproveSettings:
    from improvo.improvement.settings import ImproveSettings

    paper, usual = _paper_run(), ImproveSettings()
    training = replace(_paper_training(), optimiser=usual.training.optimiser)
    return replace(usual, odometry=paper.odometry, labels=paper.labels, recipe="tracks", training=training)


def _paper_pose() -> PoseCommandSettings:
    from improvo.evaluation.settings import PoseCommandSettings, PoseSettings

    return PoseCommandSettings(pose=PoseSettings(estimators=("opencv",)))


def _paper_vo() -> VoCommandSettings:
    from improvo.evaluation.settings import VoCommandSettings

    return VoCommandSettings(odometry=_paper_run().odometry)


def _simulations() -> dict[str, Callable[[], Any]]:
    from functools import partial

    from improvo.simulation.settings import PRESETS
    from improvo.simulation.settings import preset as simulation

    return {name: partial(simulation, name) for name in PRESETS}


_PRESETS: dict[str, dict[str, Callable[[], Any]]] = {
    "RunSettings": {PAPER: _paper_run},
    "DenseRunSettings": {PAPER: _paper_dense_run},
    "LabelRunSettings": {PAPER: _paper_label},
    "ShapesSettings": {PAPER: _paper_shapes},
    "HomographiesSettings": {PAPER: _paper_homographies},
    "OdometryTrainingSettings": {PAPER: _paper_training},
    "ImproveSettings": {PAPER: _paper_improve},
    "PoseCommandSettings": {PAPER: _paper_pose},
    "VoCommandSettings": {PAPER: _paper_vo},
}
