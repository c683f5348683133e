"""The table of all commands: what each is for, the module that does it, and the settings that it reads.

A command is a module under `improvo.cli` with `add_arguments(parser)` and `run(arguments)`, which returns an exit
status or None; where a module has several, `module:name` means its `add_name_arguments` and `run_name`. Modules are
light: heavy imports belong inside `run`. A new command is a module and a line here.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import argparse


@dataclass(frozen=True)
class Command:
    """A verb, or a sub-verb."""

    help: str
    module: str = ""  # under improvo.cli; empty where there are sub-verbs
    settings: str = ""  # `module:class` that --config, --set and --preset speak of
    figures: bool = False  # it ends in figures, which --json prints for programs
    parts: Mapping[str, Command] = field(default_factory=dict)
    part_name: str = "WHAT"  # of the sub-verb, in the usage

    def functions(self) -> tuple[Callable[[argparse.ArgumentParser], None], Callable[[argparse.Namespace], int | None]]:
        """What adds its arguments, and what runs it."""
        name, _, part = self.module.partition(":")
        module = importlib.import_module(f"improvo.cli.{name}")
        add, run = (f"add_{part}_arguments", f"run_{part}") if part else ("add_arguments", "run")
        return getattr(module, add), getattr(module, run)

    def description(self) -> str:
        """What its help says: the text of its module, or of its function where the module has several."""
        name, _, part = self.module.partition(":")
        module = importlib.import_module(f"improvo.cli.{name}")
        return inspect.getdoc(getattr(module, f"run_{part}") if part else module) or self.help


def settings_class(name: str) -> Any:
    """The class that `module:class` names."""
    module, _, cls = name.partition(":")
    return getattr(importlib.import_module(module), cls)


def leaves() -> Iterator[tuple[tuple[str, ...], Command]]:
    """Every command that can be run, with its words."""
    for verb, command in COMMANDS.items():
        if not command.parts:
            yield (verb,), command
        for part, leaf in command.parts.items():
            yield (verb, part), leaf


_EVALUATION = "improvo.evaluation.settings"
_TRAINING = "improvo.training.settings"

COMMANDS: dict[str, Command] = {
    "run": Command(
        "visual odometry on one sequence: trajectory, map, tracks",
        "run",
        "improvo.depth.run_settings:DenseRunSettings",
        figures=True,
    ),
    "label": Command(
        "stability labels for many sequences: odometry, then the paper's rule",
        "label",
        "improvo.odometry.run_settings:LabelRunSettings",
        figures=True,
    ),
    "train": Command(
        "teach the network: drawn shapes, homographies, labelled video",
        part_name="STAGE",
        parts={
            "shapes": Command(
                "a detector from drawn shapes alone (MagicPoint)",
                "train:shapes",
                f"{_TRAINING}:ShapesSettings",
                figures=True,
            ),
            "homographies": Command(
                "detector and descriptor from any pictures, by homographic adaptation",
                "train:homographies",
                f"{_TRAINING}:HomographiesSettings",
                figures=True,
            ),
            "odometry": Command(
                "all three heads from labelled video: VO adaptation, the paper's stage",
                "train:odometry",
                f"{_TRAINING}:OdometryTrainingSettings",
                figures=True,
            ),
        },
    ),
    "improve": Command(
        "the main job: train the frontend on your video by its own odometry, keep it if it got better",
        "improve",
        "improvo.improvement.settings:ImproveSettings",
        figures=True,
    ),
    "evaluate": Command(
        "how good a frontend or a trajectory is: the paper's protocols",
        part_name="PROTOCOL",
        parts={
            "pose": Command(
                "3D-to-2D pose estimation, the paper's Table 1, for any frontends",
                "evaluate_pose",
                f"{_EVALUATION}:PoseCommandSettings",
                figures=True,
            ),
            "trajectory": Command(
                "a trajectory file against the truth: sub-trajectory errors, ATE",
                "evaluate_trajectory",
                f"{_EVALUATION}:TrajectoryCommandSettings",
                figures=True,
            ),
            "vo": Command(
                "visual odometry with and without stability weights, the paper's Table 2",
                "evaluate_vo",
                f"{_EVALUATION}:VoCommandSettings",
                figures=True,
            ),
            "homography": Command(
                "repeatability and homography accuracy on image pairs",
                "evaluate_homography",
                f"{_EVALUATION}:HomographyCommandSettings",
                figures=True,
            ),
            "stability": Command(
                "instability of labels and heads against its true cause, simulated", "evaluate_stability", figures=True
            ),
        },
    ),
    "truth": Command(
        "reference poses and camera of a recording by structure from motion",
        "truth",
        "improvo.evaluation.truth.settings:TruthCommandSettings",
        figures=True,
    ),
    "show": Command(
        "the pictures of the paper, from a run, a recording or an evaluation",
        part_name="PICTURE",
        parts={
            "map": Command("trajectory and map from above", "show_run:map"),
            "tracks": Command("sparse flow over the image, coloured by the age of the track", "show_run:frames"),
            "residuals": Command("re-projection errors over the image, blue low to red high", "show_run:frames"),
            "labels": Command("stable, unstable and ignored points over the image", "show_run:frames"),
            "live": Command("a finished run in Rerun: camera, frames, tracks, map by label", "show_run:live"),
            "stability": Command("dense stability over the image", "show_recording:stability"),
            "matches": Command("two frontends on one image pair", "show_recording:matches"),
            "accuracy": Command("pose accuracy against threshold, of several frontends", "show_run:accuracy"),
        },
    ),
    "report": Command("one HTML page about a run, labels or an evaluation", "report"),
    "export": Command(
        "what other tools read: COLMAP, Nerfstudio, trajectories, features, ONNX",
        part_name="TARGET",
        parts={
            "colmap": Command("a finished run as COLMAP's sparse model, with images", "export:colmap", figures=True),
            "nerfstudio": Command("a finished run as Nerfstudio's transforms.json, with images", "export:nerfstudio"),
            "trajectory": Command("the poses of a finished run as TUM, KITTI or EuRoC file", "export:trajectory"),
            "features": Command(
                "features and matches of a recording, for hloc or COLMAP",
                "export_features",
                "improvo.export.settings:FeatureExportSettings",
                figures=True,
            ),
            "onnx": Command("a network with its decoding, for ONNX Runtime", "export:onnx"),
        },
    ),
    "weights": Command(
        "import public weights, export ours for other programs, prepare for int8, print a model card",
        part_name="ACTION",
        parts={
            "import": Command(
                "convert a public SuperPoint weights file (three layouts, .pth or .safetensors)", "weights:import"
            ),
            "export": Command("write weights in the layout of another SuperPoint implementation", "weights:export"),
            "calibrate": Command(
                "measure activation ranges on pictures, so that weights can run in int8", "weights:calibrate"
            ),
            "show": Command("print the model card of a weights file", "weights:show"),
        },
    ),
    "info": Command(
        "what a recording was recognised as, and what is wrong with it",
        "info",
        "improvo.sequences.settings:InfoSettings",
        figures=True,
    ),
    "calibrate": Command(
        "a camera from the motion of any video, or from a recording of a board",
        "calibrate",
        "improvo.self_calibration.settings:SelfCalibrationSettings",
        figures=True,
    ),
    "simulate": Command(
        "render rooms with exact depth, poses and causes of instability",
        "simulate",
        "improvo.simulation.settings:SimulationSettings",
        figures=True,
    ),
    "demo": Command("the main job on a small bundled recording, in minutes", "demo"),
    "config": Command("print all settings of a command as YAML", "config"),
    "completion": Command("a completion script for bash, zsh or fish", "completion"),
}
