"""The preset `paper`: everything that the paper fixes of a run, and nothing else."""

from __future__ import annotations

from dataclasses import replace

from improvo.config import from_dict, to_dict
from improvo.odometry.modes.paper import SOLVER
from improvo.odometry.run_settings import LabelRunSettings, RunSettings, paper_run_settings
from improvo.odometry.settings import PAPER, OdometrySettings


def test_it_is_the_scheme_of_the_paper() -> None:
    assert PAPER.mode == "paper"
    assert PAPER.matching.max_distance == 0.7
    assert PAPER.matching.flow_outlier_limit == 0.0
    assert PAPER.window.paper_poses == 30
    assert SOLVER.max_iterations == 100
    objective = PAPER.paper_objective
    assert (objective.depth_min, objective.depth_max, objective.depth_weight) == (0.1, 5.0, 1.0)


def test_labels_are_raw_and_follow_the_rule_of_the_paper() -> None:
    labels = paper_run_settings().labels
    assert (labels.min_observations, labels.stable_mean_error, labels.unstable_max_error) == (10, 1.0, 5.0)
    assert labels.loss == "huber"
    assert not labels.quality.enabled


def test_observations_are_weighted_with_the_stability() -> None:
    frontend = paper_run_settings().frontend
    assert frontend.use_stability
    assert frontend.least_stability == 0.0, "the paper drops no keypoint"


def test_it_touches_nothing_that_the_paper_leaves_open() -> None:
    mine = LabelRunSettings(frontend=replace(LabelRunSettings().frontend, name="orb", max_keypoints=321))
    preset = paper_run_settings(mine)
    assert isinstance(preset, LabelRunSettings)
    assert preset.frontend == mine.frontend
    assert preset.sequence == mine.sequence
    assert replace(PAPER, mode="robust") == OdometrySettings(), "a setting that mode `paper` does not use was changed"


def test_it_can_be_printed_and_read_back() -> None:
    assert from_dict(RunSettings, to_dict(paper_run_settings())) == paper_run_settings()
