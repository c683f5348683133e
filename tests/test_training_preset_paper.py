"""The preset `paper` of the training stages: everything that the paper fixes, held by what it does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs the extra `train`")

from torch import Tensor  # noqa: E402
from torch.nn import functional  # noqa: E402

from improvo.cli.main import main  # noqa: E402
from improvo.frontend.architecture import Architecture  # noqa: E402
from improvo.frontend.superpoint import SuperPoint, sample_descriptors, sample_stability  # noqa: E402
from improvo.frontend.weights_files import ModelCard, load_weights, save_weights  # noqa: E402
from improvo.labeling.labeled import read_labels  # noqa: E402
from improvo.presets import preset  # noqa: E402
from improvo.stability.rule import STABLE, UNSTABLE  # noqa: E402
from improvo.training.batches.homography_pairs import PairBatches  # noqa: E402
from improvo.training.batches.tracked_pairs import TrackedPairs  # noqa: E402
from improvo.training.data.labeled_frames import FramePoints, LabeledFrames  # noqa: E402
from improvo.training.data.landmarks import Summary  # noqa: E402
from improvo.training.data.pictures import Pictures, Source  # noqa: E402
from improvo.training.data.point_labels import DUSTBIN, IGNORED, PointLabels  # noqa: E402
from improvo.training.settings import (  # noqa: E402
    HomographiesSettings,
    OdometryTrainingSettings,
    OptimiserSettings,
    PhotometricSettings,
    ShapesSettings,
    ViewSettings,
)
from improvo.training.stages.superpoint import JointStage  # noqa: E402
from improvo.training.stages.vo_adaptation import VOAdaptationStage  # noqa: E402
from labeled_scene import write_labeled_scene  # noqa: E402

TINY = Architecture("tiny", encoder=(4, 4, 4, 4, 8, 8, 8, 8), head=8, descriptor=8)
SAME_LIGHT = PhotometricSettings(
    brightness=0, contrast=(1, 1), gamma=(1, 1), shade_share=0, vignette_share=0, blur_share=0, motion_share=0, noise=0,
    speckle=0, jpeg_share=0,
)  # fmt: skip
VIEWS = ViewSettings(height=48, width=64)
PAPER = preset(OdometryTrainingSettings, "paper")


class GreyFrames:
    """Frames of one grey level each, their number; each knows 20 points, which no two frames share if `apart`."""

    size = (96, 72)

    def __init__(self, count: int, apart: bool = False) -> None:
        self.count, self.apart = count, apart

    def __len__(self) -> int:
        return self.count

    def picture(self, frame: int) -> np.ndarray:
        return np.full((72, 96), frame, np.uint8)

    def mask(self, frame: int) -> None:
        return None

    def points(self, frame: int) -> FramePoints:
        places = np.random.default_rng(0).uniform(10, 60, (20, 2))
        landmark = np.arange(20) + (20 * frame if self.apart else 0)
        return FramePoints(places, landmark, np.full(20, STABLE, np.int8), np.ones(20, np.bool_))

    def summary(self) -> Summary:
        return Summary(np.full(self.count, 20, np.uint16), stable=10, unstable=1)


def pairs_of(frames: Any, settings: OdometryTrainingSettings, batch_size: int = 50) -> TrackedPairs:
    small = replace(
        settings, views=VIEWS, photometric=SAME_LIGHT, optimiser=OptimiserSettings(batch_size=batch_size, workers=0)
    )
    return TrackedPairs([frames], small)


def frames_shown(pairs: TrackedPairs, steps: int) -> np.ndarray:
    """(N, 2) numbers of the two frames of each pair."""
    grey = [pairs[step]["images"][:, 0, 24, 32].astype(int).reshape(2, -1).T for step in range(steps)]
    return np.concatenate(grey)


def test_partners_are_uniform_within_sixty_frames_and_never_the_frame_itself() -> None:
    shown = frames_shown(pairs_of(GreyFrames(250), PAPER), 40)
    gap = shown[:, 1] - shown[:, 0]
    assert np.abs(gap).min() == 1
    assert np.abs(gap).max() == 60
    inner = gap[(shown[:, 0] >= 60) & (shown[:, 0] < 190)]  # the whole window is there
    counts = np.histogram(inner, np.arange(-60, 62, 10))[0]
    expected = len(inner) / 12
    assert len(inner) > 800
    assert ((counts - expected) ** 2 / expected).sum() < 28  # chi-square, 11 degrees of freedom: one in 300
    first = shown[shown[:, 0] < 5, 1]  # where the window is cut short no frame is drawn more often than others
    assert first.min() <= 12
    assert first.max() >= 50
    ours = frames_shown(pairs_of(GreyFrames(250), replace(PAPER, pairs=OdometryTrainingSettings().pairs)), 4)
    assert (ours[:, 0] == ours[:, 1]).mean() > 0.15


def test_frames_that_share_nothing_are_a_pair_all_the_same() -> None:
    pairs = pairs_of(GreyFrames(100, apart=True), PAPER, batch_size=8)
    shown = frames_shown(pairs, 4)
    assert (shown[:, 0] != shown[:, 1]).all()
    batch = pairs[0]
    assert not batch["valid"].any()
    assert (batch["cells"] < DUSTBIN).any()
    assert (batch["stability"] == 1).any()


def test_each_image_has_a_homography_of_its_own() -> None:
    batch = pairs_of(GreyFrames(100), PAPER, batch_size=8)[0]  # every point is at the same place in all frames
    a, b, valid = batch["points_a"], batch["points_b"], batch["valid"]
    moved = np.linalg.norm(a - b, axis=2)[valid]
    assert len(moved) > 20
    assert np.median(moved) > 3


def random_batch(seed: int = 0) -> dict[str, Tensor]:
    """Of two pairs of views, with everything that VO adaptation is taught."""
    rng = np.random.default_rng(seed)
    cells = rng.choice([IGNORED, 5, 40, DUSTBIN], (4, 6, 8), p=[0.4, 0.1, 0.1, 0.4])
    batch = {
        "images": rng.uniform(0, 1, (4, 1, 48, 64)).astype(np.float32),
        "cells": cells.astype(np.int64),
        "points_a": rng.uniform(0, 47, (2, 12, 2)).astype(np.float32),
        "points_b": rng.uniform(0, 47, (2, 12, 2)).astype(np.float32),
        "valid": np.arange(12)[None].repeat(2, 0) < 7,
        "negative": np.arange(12)[None].repeat(2, 0) < 10,
        "stability_points": rng.uniform(0, 47, (4, 9, 2)).astype(np.float32),
        "stability": np.array([1, 1, 1, 1, 1, 0, 0, IGNORED, IGNORED])[None].repeat(4, 0),
    }
    return {name: torch.from_numpy(values) for name, values in batch.items()}


def hinge_by_hand(network_a: np.ndarray, network_b: np.ndarray, batch: dict[str, Tensor]) -> float:
    """SuperPoint's equations 4 to 6 over the points that are known, one pair of descriptors after the other."""
    places, valid, known = (batch[name].numpy() for name in ("points_b", "valid", "negative"))
    total, count = 0.0, 0
    for pair in range(len(valid)):
        for n in np.flatnonzero(valid[pair]):
            for m in np.flatnonzero(known[pair]):
                similarity = float(network_a[pair, n] @ network_b[pair, m])
                same = np.linalg.norm(places[pair, n] - places[pair, m]) <= 8
                total += 250 * max(0.0, 1 - similarity) if same else max(0.0, similarity - 0.2)
                count += 1
    return total / count


def test_the_losses_are_the_plain_ones() -> None:
    torch.manual_seed(0)
    stage, batch = VOAdaptationStage(SuperPoint(TINY).eval(), PAPER, None), random_batch()
    losses = stage.losses(batch)
    output = stage.network(batch["images"])
    plain = functional.cross_entropy(output.detector_logits, batch["cells"], ignore_index=IGNORED)
    assert losses["detector"].item() == pytest.approx(plain.item(), rel=1e-5)
    first, second = output.descriptors.chunk(2)
    a, b = sample_descriptors(first, batch["points_a"]), sample_descriptors(second, batch["points_b"])
    assert losses["descriptor"].item() == pytest.approx(hinge_by_hand(a.detach().numpy(), b.detach().numpy(), batch))
    sampled = sample_stability(output.stability_logits, batch["stability_points"])
    unbalanced = functional.cross_entropy(sampled.transpose(1, 2), batch["stability"], ignore_index=IGNORED)
    assert losses["stability"].item() == pytest.approx(unbalanced.item(), rel=1e-5)
    losses["loss"].backward()
    assert stage.log_scale.grad is None  # the temperature of InfoNCE has no part in it


def test_the_defaults_are_not_the_plain_ones() -> None:
    torch.manual_seed(0)
    network, batch = SuperPoint(TINY).eval(), random_batch()
    paper = VOAdaptationStage(network, PAPER, None).losses(batch)
    ours = VOAdaptationStage(network, OdometryTrainingSettings(), 4.0).losses(batch)
    for name in ("detector", "descriptor", "stability"):
        assert paper[name].item() != pytest.approx(ours[name].item(), rel=1e-3)


def test_labels_are_those_of_single_tracks_where_they_were_observed(tmp_path: Path) -> None:
    store = write_labeled_scene(tmp_path / "labels", keypoint_noise=0.8, unstable_error=0.6, wrong_link=True)
    sequence = read_labels(store)[0]
    frames = LabeledFrames(sequence, 160, PAPER.landmarks)
    tracks, points = sequence.tracks, sequence.points
    for frame in (5, 20, 35):
        known, rows = frames.points(frame), np.flatnonzero(tracks.frame == frame)
        assert known.seen.all()
        order, there = np.lexsort(known.points.T), np.lexsort(tracks.keypoints[rows].T)
        np.testing.assert_allclose(known.points[order], tracks.keypoints[rows][there])
        labels = points.stability[np.searchsorted(points.track, tracks.track[rows])]
        np.testing.assert_array_equal(known.stability[order], labels[there])
    assert (frames.points(5).stability == UNSTABLE).any()


def test_homographies_have_the_plain_losses_and_no_drawn_shapes() -> None:
    settings = replace(preset(HomographiesSettings, "paper"), views=VIEWS, optimiser=OptimiserSettings(batch_size=2))
    assert settings.shapes == 0
    picture = np.random.default_rng(0).integers(0, 255, (96, 128)).astype(np.uint8)
    labels = PointLabels(np.array([[40.0, 40.0], [80.0, 60.0]], np.float32), np.ones(2, np.float32))
    batches = PairBatches(Pictures((Source("noise", (picture,), ("noise",), 1.0),)), [[labels]], settings)
    batch = {name: torch.from_numpy(values) for name, values in batches[0].items()}
    batch["images"] = batch["images"].float() / 255
    torch.manual_seed(0)
    stage = JointStage(SuperPoint(replace(TINY, stability=False)).eval(), settings)
    losses = stage.losses(batch)
    shared = stage.network.encode(batch["images"])
    plain = functional.cross_entropy(stage.network.detector(shared), batch["cells"], ignore_index=IGNORED)
    assert losses["detector"].item() == pytest.approx(plain.item(), rel=1e-5)
    maps = functional.normalize(stage.network.descriptor(shared), dim=1).flatten(2).transpose(1, 2).detach()
    a, b = (part.numpy() for part in maps.chunk(2))  # all 6 × 8 cells of either view
    places = batch["points_a"][0].numpy()
    total = 0.0
    for pair in range(2):
        for n in np.flatnonzero(batch["valid"][pair].numpy()):
            same = np.linalg.norm(batch["points_b"][pair, n].numpy() - places, axis=1) <= 8
            similarity = b[pair] @ a[pair, n]
            total += np.where(same, 250 * np.maximum(0, 1 - similarity), np.maximum(0, similarity - 0.2)).sum()
    assert losses["descriptor"].item() == pytest.approx(total / (int(batch["valid"].sum()) * 48), rel=1e-4)


def test_shapes_have_the_plain_detector_loss() -> None:
    assert preset(ShapesSettings, "paper").detector.position_weight == 0


def test_the_preset_trains_by_command(tmp_path: Path) -> None:
    torch.manual_seed(0)
    start = tmp_path / "tiny.safetensors"
    tensors = {name: value.numpy() for name, value in SuperPoint(TINY).state_dict().items()}
    save_weights(start, tensors, ModelCard(architecture=TINY, licence="Apache-2.0"))
    store = write_labeled_scene(tmp_path / "labels")
    quick = ["--preset", "paper", "--steps", "4", "--batch-size", "2", "--workers", "0", "--threads", "1"]
    quick += ["--set", "views.height=48", "--set", "views.width=64"]
    command = ["train", "odometry", str(store), "-o", str(tmp_path / "out"), "--from", str(start), *quick]
    assert main(command) == 0
    trained = load_weights(tmp_path / "out" / "weights.safetensors")
    assert trained.card.training["settings"]["descriptor_loss"] == "hinge"
    assert any(not np.array_equal(trained.tensors[name], tensors[name]) for name in trained.tensors)
