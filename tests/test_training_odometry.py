"""VO adaptation: what labeled frames tell, the pairs made of them, and that a network learns from it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs the extra `train`")

from improvo.cli.main import main  # noqa: E402
from improvo.frontend.architecture import Architecture  # noqa: E402
from improvo.frontend.runtime_torch import load_network  # noqa: E402
from improvo.frontend.superpoint import SuperPoint, sample_stability  # noqa: E402
from improvo.frontend.weights_files import ModelCard, load_weights, save_weights  # noqa: E402
from improvo.labeling.labeled import read_labels  # noqa: E402
from improvo.stability.rule import IGNORE, STABLE, UNSTABLE  # noqa: E402
from improvo.training.batches.tracked_pairs import TrackedPairs  # noqa: E402
from improvo.training.data.labeled_frames import LabeledFrames, common_points  # noqa: E402
from improvo.training.data.point_labels import IGNORED  # noqa: E402
from improvo.training.settings import (  # noqa: E402
    LandmarkSettings,
    OdometryTrainingSettings,
    OptimiserSettings,
    PairSettings,
    ViewSettings,
)
from improvo.training.stages.losses import info_nce_loss, stability_loss  # noqa: E402
from labeled_scene import (  # noqa: E402
    CAMERA,
    FAR,
    FRAMES,
    HALF,
    NEAR,
    draw,
    project,
    scene_points,
    write_labeled_scene,
)

TINY = Architecture("tiny", encoder=(4, 4, 4, 4, 8, 8, 8, 8), head=8, descriptor=8, stability=False)
PAPER = LandmarkSettings(
    shared=False, unseen=False, reprojected=False, unstable_median_error=0.0, unstable_largest_step=1.0
)
TRACKS_ONLY = LandmarkSettings(unseen=False, reprojected=False)
LATE = HALF + 20  # a frame in which no track follows the odd far points any more


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_labeled_scene(tmp_path_factory.mktemp("scene") / "labels")


@pytest.fixture(scope="module")
def tiny_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    tensors = {name: value.numpy() for name, value in SuperPoint(TINY).state_dict().items()}
    save_weights(path, tensors, ModelCard(architecture=TINY, licence="Apache-2.0"))
    return path


def frames_of(store: Path, settings: LandmarkSettings) -> LabeledFrames:
    return LabeledFrames(read_labels(store)[0], 160, settings)


def truth(frame: int, kind: str) -> np.ndarray:
    """Pixels (N, 2) of odd far points (`odd`) or near ones (`near`) inside the frame."""
    xyz = scene_points()
    chosen = (xyz[:, 2] == FAR) & (np.arange(len(xyz)) % 2 == 1) if kind == "odd" else xyz[:, 2] == NEAR
    pixels = np.array([project(point, frame) for point in xyz[chosen]])
    return pixels[((pixels >= 0) & (pixels <= [CAMERA.width - 1, CAMERA.height - 1])).all(axis=1)]


def distances(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - others[None], axis=2).min(axis=1)


def test_short_tracks_of_one_map_point_teach_together_and_in_the_paper_not(store: Path) -> None:
    second_track = HALF + 5  # of six observations: too short for a label of its own
    together, alone = (frames_of(store, settings).points(second_track) for settings in (TRACKS_ONLY, PAPER))
    assert (alone.stability == IGNORE).sum() > 50
    assert (together.stability == STABLE).sum() > (alone.stability == STABLE).sum() + 50
    assert (together.stability == UNSTABLE).sum() == (alone.stability == UNSTABLE).sum() > 20
    first = frames_of(store, TRACKS_ONLY).points(3)
    rows_a, rows_b = common_points(first, together)
    moved = first.points[rows_a] - together.points[rows_b]
    depth = CAMERA.fx * 0.03 * (second_track - 3) / moved[:, 0]
    assert len(rows_a) > 100
    assert np.allclose(moved[:, 1], 0, atol=1e-3)
    assert np.all(np.isclose(depth, FAR, rtol=1e-3) | np.isclose(depth, NEAR, rtol=1e-3))


def test_a_point_that_no_track_sees_is_known_where_its_projection_is_visible(store: Path) -> None:
    odd = truth(LATE, "odd")
    odd = odd[project(np.array([1.6, 0, FAR]), LATE)[0] > odd[:, 0] + 2]  # the stable ones
    hidden = distances(odd, truth(LATE, "near")) < 4
    assert hidden.sum() >= 3
    assert (~hidden).sum() > 30
    tracked, everywhere = (frames_of(store, s).points(LATE) for s in (TRACKS_ONLY, LandmarkSettings()))
    assert (distances(odd, tracked.points) > 0.5).mean() > 0.9
    known = distances(odd, everywhere.points[everywhere.stability == STABLE]) < 1e-3
    assert known[~hidden].mean() > 0.8
    assert not known[hidden].any()


def test_stable_points_lie_at_their_projections(tmp_path: Path) -> None:
    noisy = write_labeled_scene(tmp_path / "noisy", keypoint_noise=0.8)
    at_keypoint, at_projection = (frames_of(noisy, s).points(20) for s in (TRACKS_ONLY, LandmarkSettings(unseen=False)))
    exact = np.array([project(point, 20) for point in scene_points()])
    stable = at_keypoint.stability == STABLE
    assert np.median(distances(at_keypoint.points[stable], exact)) > 0.2
    assert distances(at_projection.points[at_projection.stability == STABLE], exact).max() < 1e-3


def test_an_unstable_label_of_one_wrong_link_does_not_teach(tmp_path: Path) -> None:
    jumps = write_labeled_scene(tmp_path / "jumps", unstable_error=0.6)  # the median of the errors, not their largest
    published, sure = (frames_of(jumps, s).points(5).stability for s in (PAPER, LandmarkSettings(unseen=False)))
    assert (published == UNSTABLE).sum() > 20
    assert not (sure == UNSTABLE).any()


def test_a_thing_that_moves_teaches_and_a_track_that_jumps_once_does_not(tmp_path: Path) -> None:
    moves = write_labeled_scene(tmp_path / "moves")
    jumps = write_labeled_scene(tmp_path / "jumps", wrong_link=True)
    everything = LandmarkSettings(unseen=False, unstable_largest_step=1.0)
    for store, taught in ((moves, True), (jumps, False)):
        labeled = (frames_of(store, everything).points(5).stability == UNSTABLE).sum()
        sure = (frames_of(store, LandmarkSettings(unseen=False)).points(5).stability == UNSTABLE).sum()
        assert labeled > 20
        assert sure == (labeled if taught else 0)


def test_stability_is_taught_only_where_a_track_saw_the_point(store: Path) -> None:
    known = frames_of(store, LandmarkSettings()).points(LATE)
    assert (~known.seen & (known.stability == STABLE)).sum() > 30
    observed = frames_of(store, TRACKS_ONLY).points(LATE)
    assert observed.seen.all()
    assert distances(known.points[known.seen], observed.points).max() < 2.1


def settings_of(**changes: Any) -> OdometryTrainingSettings:
    optimiser = OptimiserSettings(
        steps=120, batch_size=3, warmup_steps=5, threads=1, workers=0, learning_rate=5e-3, log_every=10, ema=0.9
    )
    settings = OdometryTrainingSettings(
        longer_side=160, pairs=PairSettings(points=48, stability_points=60), optimiser=optimiser,
        views=ViewSettings(height=64, width=96, rotation_degrees=20.0),
    )  # fmt: skip
    return replace(settings, **changes)


def test_pairs_show_the_same_points_and_repeat_for_the_same_seed(store: Path) -> None:
    # without augmentation of light the taught places can be looked at: the same dot has the same brightness
    from improvo.training.settings import PhotometricSettings

    plain = PhotometricSettings(
        brightness=0, contrast=(1, 1), gamma=(1, 1), shade_share=0, vignette_share=0, blur_share=0, motion_share=0,
        noise=0, speckle=0, jpeg_share=0,
    )  # fmt: skip
    upright = ViewSettings(64, 96, 1.0, 1.0, rotation_degrees=0, perspective=0, stretch=0)
    settings = settings_of(photometric=plain, views=upright)
    pairs = TrackedPairs([frames_of(store, LandmarkSettings())], settings)
    agreeing, taught = 0, 0
    for step in range(4):
        batch = pairs[step]
        images = batch["images"][:, 0].astype(float)
        for a, b, points_a, points_b, valid in zip(
            images[:3], images[3:], batch["points_a"], batch["points_b"], batch["valid"], strict=True
        ):
            for p, q in zip(points_a[valid].round().astype(int), points_b[valid].round().astype(int), strict=True):
                agreeing += abs(a[p[1], p[0]] - b[q[1], q[0]]) < 25
                taught += 1
    assert taught > 200
    assert agreeing / taught > 0.8  # dots overlap here and there; by chance it would be about a third
    again = TrackedPairs([frames_of(store, LandmarkSettings())], settings)[3]
    assert all(np.array_equal(again[name], batch[name]) for name in batch)
    assert not np.array_equal(batch["images"], pairs[4]["images"])


@pytest.mark.parametrize("processes", [2, 3])
def test_processes_together_make_the_batch_of_one(store: Path, processes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    frames, settings = [frames_of(store, LandmarkSettings())], settings_of()
    whole = TrackedPairs(frames, settings)[1]
    size = settings.optimiser.batch_size
    monkeypatch.setenv("WORLD_SIZE", str(processes))
    for rank in range(processes):
        monkeypatch.setenv("RANK", str(rank))
        part, own = TrackedPairs(frames, settings)[1], list(range(rank, size, processes))
        for name, values in part.items():
            rows = own if len(whole[name]) == size else [*own, *(size + number for number in own)]
            np.testing.assert_array_equal(values, whole[name][rows], err_msg=name)


def test_the_detector_ignores_what_is_unknown(store: Path) -> None:
    pairs = TrackedPairs([frames_of(store, PAPER)], settings_of())
    values = np.concatenate([pairs[step]["cells"].ravel() for step in range(4)])
    assert (values == IGNORED).any()
    assert (values == 64).any()
    assert (values < 64).any()
    only_known = replace(settings_of().pairs, untracked_is_background=False)
    values = TrackedPairs([frames_of(store, PAPER)], settings_of(pairs=only_known))[0]["cells"]
    assert not (values == 64).any()
    assert (values >= 0).any()


def test_keypoints_without_a_partner_are_wrong_ones_for_the_others() -> None:
    descriptors = torch.eye(3)[None]
    places = torch.tensor([[[0.0, 0.0], [50.0, 0.0], [0.0, 50.0]]])
    valid = torch.tensor([[True, False, False]])
    scale = torch.tensor(2.0)
    alone = info_nce_loss(descriptors, descriptors, places, places, valid, scale, 8.0)
    among = info_nce_loss(
        descriptors, descriptors, places, places, valid, scale, 8.0, negative=torch.tensor([[True, True, False]])
    )
    assert float(alone) == pytest.approx(0.0, abs=1e-6)
    assert float(among) == pytest.approx(np.log(1 + np.exp(-2.0)), rel=1e-5)


def test_negatives_across_pairs_change_nothing_for_one_pair_and_are_harder_for_more() -> None:
    generator = torch.Generator().manual_seed(0)
    a = torch.nn.functional.normalize(torch.randn(3, 20, 16, generator=generator), dim=2)
    b = torch.nn.functional.normalize(a + 0.5 * torch.randn(3, 20, 16, generator=generator), dim=2)
    places = 100 * torch.rand(3, 20, 2, generator=generator)
    valid = torch.rand(3, 20, generator=generator) > 0.3
    scale = torch.tensor(20.0)

    def loss(rows: slice, across: bool) -> float:
        parts = [part[rows] for part in (a, b, places, places, valid)]
        return float(info_nce_loss(*parts, scale, 8.0, group=len(parts[0]) if across else 1))

    assert loss(slice(0, 1), True) == pytest.approx(loss(slice(0, 1), False))
    assert loss(slice(0, 3), True) > loss(slice(0, 3), False) + 0.1
    separate = sum(loss(slice(k, k + 1), True) * int(valid[k].sum()) for k in range(3)) / int(valid.sum())
    assert loss(slice(0, 3), False) == pytest.approx(separate)


def test_the_stability_loss_is_balanced() -> None:
    logits = torch.tensor([[[0.0, 2.0]] * 9 + [[0.0, 2.0]]])
    stability = torch.tensor([[1] * 9 + [0]])
    right, wrong = np.log(1 + np.exp(-2.0)), np.log(1 + np.exp(2.0))
    assert float(stability_loss(logits, stability, 9.0)) == pytest.approx(0.5 * (right + wrong), rel=1e-5)
    assert float(stability_loss(logits, torch.full((1, 10), IGNORED), 9.0)) == 0.0
    # where unstable labels are rarer elsewhere, the one here does not weigh as much as the nine
    assert float(stability_loss(logits, stability, 3.0)) == pytest.approx(0.5 * (right + wrong / 3), rel=1e-5)


def test_the_command_teaches_stability_and_says_so_on_the_card(
    store: Path, tiny_weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "settings.yaml"
    from improvo.config import to_yaml

    config.write_text(to_yaml(settings_of()))
    command = ["train", "odometry", str(store), "-o", str(tmp_path / "out"), "--from", str(tiny_weights)]
    assert main([*command, "--config", str(config)]) == 0
    rows = [json.loads(row) for row in (tmp_path / "out" / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["stability"] < 0.6 * rows[0]["stability"]
    assert rows[-1]["detector"] < rows[0]["detector"]
    weights = load_weights(tmp_path / "out" / "weights.safetensors")
    assert weights.card.training["stability_trained"] is True
    assert weights.card.training["start"] == "tiny.safetensors"
    network = load_network(weights)
    known = frames_of(store, PAPER).points(5)
    with torch.inference_mode():
        image = torch.from_numpy(draw(5)[None, None]).float() / 255
        logits = sample_stability(network(image).stability_logits, torch.from_numpy(known.points).float()[None])[0]
    stable = (logits[:, 1] - logits[:, 0]).numpy()
    assert np.mean(stable[known.stability == STABLE]) > np.mean(stable[known.stability == UNSTABLE]) + 1

    other = write_labeled_scene(tmp_path / "other", name="other")
    command[2] = str(other)
    assert main([*command, "--config", str(config)]) == 2
    assert "other labels" in capsys.readouterr().err


def test_pictures_are_replayed_beside_the_labels(store: Path, tiny_weights: Path, tmp_path: Path) -> None:
    import cv2

    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for number in range(3):
        cv2.imwrite(str(pictures / f"{number}.png"), 255 - draw(number))
    command = ["train", "odometry", str(store), "-o", str(tmp_path / "out"), "--from", str(tiny_weights)]
    quick = ["--steps", "6", "--workers", "0", "--batch-size", "2"]
    assert (
        main([*command, *quick, "--set", "views.height=64", "--set", "views.width=96", "--pictures", str(pictures)])
        == 0
    )
    card = load_weights(tmp_path / "out" / "weights.safetensors").card
    assert [source.name for source in card.data] == ["walls", "pictures"]

    from improvo.training.batches.homography_pairs import PairBatches
    from improvo.training.data.pictures import load_pictures
    from improvo.training.data.point_labels import load_labels
    from improvo.training.settings import HomographiesSettings

    settings = settings_of()
    loaded_pictures = load_pictures([str(pictures)], 160)
    labels = load_labels(tmp_path / "out" / "labels.npz", [3])
    other = HomographiesSettings(points=48, optimiser=settings.optimiser, views=settings.views)
    pairs = TrackedPairs([frames_of(store, PAPER)], settings, PairBatches(loaded_pictures, labels, other))
    labeled = [(pairs[step]["stability"] != IGNORED).any(axis=1)[:3] for step in range(10)]
    assert 0.2 < np.mean(labeled) < 0.8
    assert all((pairs[step]["valid"].sum(axis=1) > 0).all() for step in range(3))


def test_labels_without_enough_stable_points_are_one_line(
    store: Path, tiny_weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["train", "odometry", str(store), "-o", str(tmp_path / "out"), "--from", str(tiny_weights)]
    assert main([*command, "--set", "pairs.least_points=100000"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "stable points" in error
    assert main(["train", "odometry", str(tmp_path), "-o", str(tmp_path / "out")]) == 2


def test_frames_that_are_useful_have_stable_points(store: Path) -> None:
    frames = frames_of(store, PAPER)
    assert len(frames) == FRAMES
    assert len(frames.summary().useful_frames(16)) == FRAMES
    assert len(frames.summary().useful_frames(100000)) == 0


def test_the_stability_head_can_be_trained_alone(store: Path, tiny_weights: Path, tmp_path: Path) -> None:
    from improvo.config import to_yaml

    config = tmp_path / "settings.yaml"
    config.write_text(to_yaml(settings_of(stability_alone=True)))
    command = ["train", "odometry", str(store), "-o", str(tmp_path / "out"), "--from", str(tiny_weights)]
    assert main([*command, "--config", str(config)]) == 0
    rows = [json.loads(row) for row in (tmp_path / "out" / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["stability"] < rows[0]["stability"]
    before, after = load_weights(tiny_weights), load_weights(tmp_path / "out" / "weights.safetensors")
    assert after.architecture.stability
    for name, values in before.tensors.items():
        assert np.array_equal(after.tensors[name], values), name


def test_a_detector_can_be_left_to_replay(store: Path) -> None:
    frames = [frames_of(store, LandmarkSettings())]
    taught, left = (
        TrackedPairs(frames, settings_of(pairs=PairSettings(points=48, stability_points=60, teach_detector=teach)))[0]
        for teach in (True, False)
    )
    assert (taught["cells"] != IGNORED).any()
    assert (left["cells"] == IGNORED).all()
    assert np.array_equal(taught["points_a"], left["points_a"])


def test_masked_cells_and_points_teach_nothing(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from improvo.labeling.labeled import LabeledSequence

    mask = np.ones((120, 160), np.bool_)
    mask[60:] = False
    plain = [frames_of(store, LandmarkSettings()).points(frame) for frame in range(40)]
    assert any((known.points[~known.seen, 1] > 60).any() for known in plain)
    monkeypatch.setattr(LabeledSequence, "mask", lambda self, frame: mask)
    frames = frames_of(store, LandmarkSettings())
    for known in map(frames.points, range(40)):
        assert (known.points[~known.seen, 1] < 60).all()  # what a track saw is the business of the frontend
    upright = ViewSettings(64, 96, 1.0, 1.0, rotation_degrees=0, perspective=0, stretch=0)
    same_frame = replace(settings_of().pairs, same_frame_share=1.0)
    pairs = TrackedPairs([frames], settings_of(views=upright, pairs=same_frame))
    taught = 0
    for seed in range(8):
        first, second, places = pairs._pair(np.random.default_rng(seed))
        for view, points in ((first, places.a), (second, places.b)):
            assert view.used is not None
            whole = view.used.reshape(len(view.cells), 8, -1, 8).all(axis=(1, 3))
            assert not whole.all()
            assert (view.cells[~whole] != 64).all()
            row, column = np.nonzero((view.cells >= 0) & (view.cells < 64))
            value = view.cells[row, column]
            assert view.used[8 * row + value // 8, 8 * column + value % 8].all()
            x, y = np.rint(points[places.valid]).astype(int).T
            assert view.used[y, x].all()
            taught += len(x)
    assert taught
