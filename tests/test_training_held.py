"""Pairs made on the device, and training with the other heads held."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs the extra `train`")

from posed_room import SIZE, posed_room  # noqa: E402

from improvo.errors import ConfigError, InputError  # noqa: E402
from improvo.frontend.architecture import ARCHITECTURES  # noqa: E402
from improvo.frontend.superpoint import SuperPoint  # noqa: E402
from improvo.frontend.weights_files import DataSource, find_weights, load_weights  # noqa: E402
from improvo.training.augmentation.photometric_batch import augment_batch  # noqa: E402
from improvo.training.augmentation.views import inside, warp_image, warp_points  # noqa: E402
from improvo.training.augmentation.views_batch import random_views  # noqa: E402
from improvo.training.batches.device_pairs import DevicePairs  # noqa: E402
from improvo.training.batches.mixed_pairs import MixedPairs  # noqa: E402
from improvo.training.batches.pair_points import PairPlan, PairPoints  # noqa: E402
from improvo.training.batches.picture_store import DepthStore, PictureStore  # noqa: E402
from improvo.training.batches.posed_frames import PosedFrames  # noqa: E402
from improvo.training.data.pack import read_pack, write_pack  # noqa: E402
from improvo.training.data.pictures import Pictures, Source  # noqa: E402
from improvo.training.data.posed_sequence import overlapping_pairs  # noqa: E402
from improvo.training.held_settings import DevicePairSettings, HeldSettings  # noqa: E402
from improvo.training.held_training import train_held  # noqa: E402
from improvo.training.settings import OptimiserSettings, PhotometricSettings, ViewSettings  # noqa: E402
from improvo.training.stages.base import Stage  # noqa: E402
from improvo.training.stages.held import HeldStage  # noqa: E402
from improvo.training.stages.losses import held_loss, info_nce_loss  # noqa: E402
from improvo.training.trainer import Trainer  # noqa: E402
from training_examples import stopped_after  # noqa: E402

CPU = torch.device("cpu")
AS_IT_IS = PhotometricSettings(
    brightness=0, contrast=(1.0, 1.0), gamma=(1.0, 1.0), shade_share=0, vignette_share=0, blur_share=0, motion_share=0,
    noise=0, speckle=0, jpeg_share=0,
)  # fmt: skip
SMALL = HeldSettings(
    views=ViewSettings(height=96, width=128, smallest_zoom=0.8, largest_zoom=1.2, rotation_degrees=15.0),
    pairs=DevicePairSettings(points=64, group=2),
    photometric=AS_IT_IS,
    optimiser=OptimiserSettings(
        steps=12, batch_size=4, warmup_steps=2, decay_steps=4, threads=1, workers=0, log_every=2, learning_rate=5e-4,
        checkpoint_minutes=0.0, precision="float32",
    ),
)  # fmt: skip


def no_keypoints(views: Any, layers: int = 0) -> Any:
    return torch.zeros(len(views), 65, views.shape[2] // 8, views.shape[3] // 8), views


def photographs(count: int = 5, size: tuple[int, int] = (200, 150)) -> Source:
    rng = np.random.default_rng(3)
    pictures = [
        cv2.resize(rng.integers(0, 255, (size[1] // 6, size[0] // 6), np.uint8), size, interpolation=cv2.INTER_CUBIC)
        for _ in range(count)
    ]
    return Source("photographs", tuple(pictures), ("",) * count, 1.0)


def grey_at(image: Any, points: Any) -> Any:
    return cv2.remap(image.numpy().astype(np.float32), points.numpy()[None], None, cv2.INTER_LINEAR)[0]


def test_many_views_at_once_are_views_of_the_picture() -> None:
    rng, settings = np.random.default_rng(0), ViewSettings()
    centres = rng.uniform((0, 0), (319, 239), (400, 2))
    centres[::2] = np.nan
    found = random_views(rng, settings, np.tile([320.0, 240.0], (400, 1)), centres)
    places = np.array([[79.5, 59.5], [0.0, 0.0], [159.0, 119.0]])
    angles = []
    for H in found:
        shown = warp_points(np.linalg.inv(H), places)
        assert np.isfinite(shown).all()
        assert inside(shown[0], 320, 240)
        assert np.allclose(warp_points(H, shown), places, atol=1e-6)
        along = shown[2] - shown[1]
        angles.append(np.degrees(np.arctan2(along[1], along[0])) - np.degrees(np.arctan2(119, 159)))
    assert np.abs(angles).max() < 80
    assert 10 < np.std(angles) < 30


def test_views_of_pictures_of_any_size_are_those_of_opencv() -> None:
    pictures = [*photographs(2).pictures, *photographs(2, (90, 240)).pictures]
    store = PictureStore(pictures, CPU)
    rows = np.array([3, 0, 2, 1])
    rng = np.random.default_rng(1)
    settings = ViewSettings(height=48, width=64, smallest_zoom=0.6, largest_zoom=1.2)
    H = random_views(rng, settings, store.sizes[rows].astype(np.float64), np.full((4, 2), np.nan))
    H[0, :2] += 20 * H[0, 2]  # looks beyond the picture, which is mirrored there
    views = store.views(rows, H, 64, 48)
    for view, row, homography in zip(views[:, 0].numpy(), rows, H, strict=True):
        wanted = warp_image(pictures[row], homography, 64, 48)
        assert np.abs(view - wanted).mean() < 1.0


def test_a_view_from_afar_looks_at_the_halved_picture() -> None:
    picture = np.indices((120, 160)).sum(axis=0).astype(np.uint8) % 2 * 255  # a board of single pixels
    view = PictureStore([picture], CPU).views(np.array([0]), np.diag([0.5, 0.5, 1.0])[None], 80, 60)
    assert np.abs(view.numpy() - 127.5).max() < 2


def test_inverse_depth_is_exact_on_planes_and_unknown_at_steps() -> None:
    room = posed_room(1)
    values = room.inverse_depth[0]
    store = DepthStore([values, values], np.array([[4.0, 4.0]] * 2), CPU)
    points = torch.tensor([[[20.0, 40.0], [20.5, 100.25], [-3.0, 5.0], [500.0, 5.0]]])
    found = store.sample(np.array([1]), points)[0]
    rays = np.column_stack([points[0, :2].numpy(), [1, 1]]) @ np.linalg.inv(room.K).T
    assert np.allclose(found[:2], rays @ np.array([0.15, 0, 1.0]) / 3.0, rtol=1e-4)
    assert (found[2:] == 0).all()
    edges = (values == 0).sum()
    assert 10 < edges < 200  # the outline of the panel alone


def test_light_and_sensor_are_the_same_for_the_same_seed() -> None:
    images = torch.full((6, 1, 48, 64), 100.0)

    def changed(settings: PhotometricSettings) -> Any:
        return augment_batch(images, np.random.default_rng(1), torch.Generator().manual_seed(2), settings)

    everything = PhotometricSettings(shade_share=1, vignette_share=1, blur_share=0.5, motion_share=0.5, jpeg_share=0.5)
    assert (changed(AS_IT_IS) == 100).all()
    first = changed(everything)
    assert first.dtype == torch.uint8
    assert torch.equal(first, changed(everything))
    assert first.float().std() > 5


def test_blocks_are_compressed_as_jpeg_does() -> None:
    picture = photographs(1, (160, 120)).pictures[0]
    settings = replace(AS_IT_IS, jpeg_share=1.0, jpeg_quality=(30, 31))
    made = augment_batch(
        torch.from_numpy(picture)[None, None].float(), np.random.default_rng(0), torch.Generator(), settings
    )[0, 0].numpy()
    encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 30])[1]
    wanted = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
    off = np.abs(wanted.astype(float) - made).mean()
    assert off < 0.25 * np.abs(wanted.astype(float) - picture).mean()


def test_points_of_two_frames_show_the_same_place_and_hidden_ones_do_not_count() -> None:
    rooms = [posed_room(seed=seed) for seed in range(2)]
    settings = replace(SMALL, pairs=replace(SMALL.pairs, posed_share=1.0, points=300))
    batches = DevicePairs(Pictures(()), rooms, settings, no_keypoints, None, CPU)
    assert len(batches) == 12
    off = []
    for step in range(4):
        batch = batches[step]
        valid = batch["valid"]
        assert valid.float().mean() > 0.5
        for pair in range(4):
            a = grey_at(batch["images"][pair, 0], batch["points_a"][pair][valid[pair]])
            b = grey_at(batch["images"][4 + pair, 0], batch["points_b"][pair][valid[pair]])
            off.append(np.abs(a - b))
            assert np.corrcoef(a, b)[0, 1] > 0.9
    off = np.concatenate(off)
    assert np.median(off) < 4
    assert (off > 40).mean() < 0.02  # nothing is taken for what stands before it
    again = batches[3]
    assert all(torch.equal(batch[name], again[name]) for name in batch)
    assert not torch.equal(batches[0]["images"], batch["images"])


def test_pictures_and_frames_are_mixed_and_the_control_shows_one_frame_twice() -> None:
    for two_frames in (True, False):
        settings = replace(SMALL, pairs=replace(SMALL.pairs, two_frames=two_frames))
        batches = DevicePairs(Pictures((photographs(),)), [posed_room()], settings, no_keypoints, no_keypoints, CPU)
        batch = batches[0]
        assert sorted(batch["scenes"].tolist()) == [0, 0, 1, 1]
        assert len(batch["stability"]) == 2
        for pair in range(4):
            valid = batch["valid"][pair]
            a = grey_at(batch["images"][pair, 0], batch["points_a"][pair][valid])
            b = grey_at(batch["images"][4 + pair, 0], batch["points_b"][pair][valid])
            assert np.median(np.abs(a - b)) < 6


def test_points_are_taken_at_keypoints_of_the_detector() -> None:
    def corner_of_each_cell(views: Any, layers: int = 0) -> Any:
        logits, stem = no_keypoints(views)
        logits[:, 3 * 8 + 5] = 9.0
        return logits, stem

    batches = DevicePairs(Pictures((photographs(),)), [], SMALL, corner_of_each_cell, None, CPU)
    places = batches[0]["points_a"][:, :32] % 8
    assert torch.equal(places, torch.tensor([5.0, 3.0]).expand_as(places))


def test_pairs_are_moved_to_where_the_pictures_agree() -> None:
    room = posed_room()
    poses = room.world_from_cam.copy()
    poses[::2, 1, 3] += 0.03  # every other camera a little higher than it was
    settings = replace(SMALL, pairs=replace(SMALL.pairs, posed_share=1.0, points=300))
    off = []
    for moved in (False, True):
        chosen = replace(settings, pairs=replace(settings.pairs, aligned=moved))
        batches = DevicePairs(Pictures(()), [replace(room, world_from_cam=poses)], chosen, no_keypoints, None, CPU)
        batch = batches[0]
        differences = []
        for pair, valid in enumerate(batch["valid"]):
            assert valid.float().mean() > 0.15
            a = grey_at(batch["images"][pair, 0], batch["points_a"][pair][valid])
            b = grey_at(batch["images"][4 + pair, 0], batch["points_b"][pair][valid])
            differences.append(np.abs(a - b))
        off.append(np.median(np.concatenate(differences)))
    assert off[1] < 0.6 * off[0]


def test_whole_frames_are_shown_as_they_are_and_keypoints_without_a_partner_are_wrong_ones() -> None:
    room = posed_room()
    asked: list[int] = []

    def corner_of_each_cell(views: Any, layers: int = 0) -> Any:
        asked.append(len(views))
        logits, stem = no_keypoints(views)
        logits[:, 3 * 8 + 5] = 9.0
        return logits, stem

    pairs = replace(SMALL.pairs, whole_frames=1, whole_points=200, alone=40, largest_gap=6.0)
    batches = DevicePairs(
        Pictures((photographs(),)), [room], replace(SMALL, pairs=pairs), corner_of_each_cell, None, CPU
    )
    width, height = SIZE[0] // 8 * 8, SIZE[1] // 8 * 8
    shown, lonely = set(), 0
    for step in range(12):
        batch = batches[step]
        assert batch["images"].shape == (2, 1, height, width)
        for image in batch["images"][:, 0].numpy():
            shown.add(next(n for n, picture in enumerate(room.pictures) if (picture[:height, :width] == image).all()))
        valid, negative = batch["valid"][0], batch["negative"][0]
        assert valid.shape == (240,)
        assert not valid[200:].any()
        assert (negative[:200] == valid[:200]).all()
        a = grey_at(batch["images"][0, 0], batch["points_a"][0][valid])
        b = grey_at(batch["images"][1, 0], batch["points_b"][0][valid])
        assert np.corrcoef(a, b)[0, 1] > 0.9
        for name, wrong in (("points_a", negative), ("points_b", batch["negative_b"][0])):
            points = batch[name][0][wrong & ~valid]
            lonely += len(points)
            assert torch.equal(points % 8, torch.tensor([5.0, 3.0]).expand_as(points))  # keypoints
    assert lonely > 10
    assert len(asked) == len(shown)  # each frame was looked at once
    again = batches[3]
    forgetful = DevicePairs(
        Pictures(()), [room], replace(SMALL, pairs=replace(pairs, frames_remembered=1)), corner_of_each_cell, None, CPU
    )[3]
    assert all(torch.equal(again[name], forgetful[name]) for name in again)


def test_where_no_frames_overlap_and_in_the_control_pairs_are_views() -> None:
    pairs = replace(SMALL.pairs, whole_frames=1)
    settings = replace(SMALL, pairs=pairs)
    control = replace(SMALL, pairs=replace(pairs, two_frames=False))
    for chosen, posed in ((settings, []), (control, [posed_room()])):
        batches = DevicePairs(Pictures((photographs(),)), posed, chosen, no_keypoints, None, CPU)
        assert batches[0]["images"].shape == (8, 1, 96, 128)


def test_keypoints_that_the_other_view_does_not_show_lie_outside_of_it() -> None:
    settings = replace(SMALL, pairs=replace(SMALL.pairs, alone=30, posed_share=0.0, two_frames=False))
    source = photographs(1)
    batches = DevicePairs(Pictures((source,)), [], settings, no_keypoints, None, CPU)
    generator = np.random.default_rng([settings.optimiser.seed, 0, 0])
    generator.integers(2**62)
    plan = batches._plan(generator, 4)
    batch = batches[0]
    alone = {"points_a": batch["negative"] & ~batch["valid"], "points_b": batch["negative_b"] & ~batch["valid"]}
    assert all(rows.any() and not rows[:, :64].any() for rows in alone.values())
    for pair in range(4):
        a, b = plan.view_from_picture[pair], plan.view_from_picture[4 + pair]
        for name, motion in (("points_a", b @ np.linalg.inv(a)), ("points_b", a @ np.linalg.inv(b))):
            elsewhere = warp_points(motion, batch[name][pair][alone[name][pair]].numpy().astype(np.float64))
            assert not inside(elsewhere, 128, 96, margin=-8.0).any()


def test_what_is_behind_the_camera_is_far_outside_and_not_shown() -> None:
    behind = np.eye(4)
    behind[2, 3] = -10
    frames = PosedFrames([posed_room(2)], CPU)
    carried = frames.carry(np.array([[0, 1]]), torch.tensor([[[50.0, 50.0]]]), torch.tensor([[0.5]]), behind[None])
    assert not carried.ahead.any()
    assert (carried.places < -1000).all()
    room = posed_room(2)
    poses = room.world_from_cam.copy()
    poses[1] = poses[0] @ np.diag([-1.0, 1.0, -1.0, 1.0])  # frame 1 looks the other way
    turned = replace(room, world_from_cam=poses)
    pictures = PictureStore(list(room.pictures), CPU)
    points = PairPoints(pictures, PosedFrames([turned], CPU), None, SMALL)
    H = np.diag([0.5, 0.5, 1.0])  # what lies right before the corner of the picture is near that of the view
    views = np.stack([np.eye(3), H])
    plan = PairPlan(np.array([[0, 1]]), np.zeros(1, np.int64), np.eye(3)[None], views, 1, SIZE)
    places = torch.rand(1, 300, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([159.0, 119.0])
    seen = points._in_pictures(plan, places)
    known = seen.posed.inverse_depth > 0
    assert known.float().mean() > 0.5
    assert torch.equal(points._absent(plan, seen), known)


def test_frames_that_share_nothing_make_no_pair() -> None:
    room = posed_room(3)
    apart = replace(room, world_from_cam=room.world_from_cam + 10 * np.eye(4, k=3) * np.arange(3)[:, None, None])
    pairs = overlapping_pairs(room, DevicePairSettings())
    assert pairs is not None
    assert len(pairs.frames) == 6
    assert overlapping_pairs(apart, DevicePairSettings()) is None
    assert overlapping_pairs(room, DevicePairSettings(largest_gap=0.5)) is None
    with pytest.raises(InputError, match="nothing to train on"):
        DevicePairs(Pictures(()), [], SMALL, no_keypoints, None, CPU)
    for two_frames in (True, False):
        settings = replace(SMALL, pairs=replace(SMALL.pairs, two_frames=two_frames))
        with pytest.raises(InputError, match="no two frames of room-0 show enough of the same places; give pictures"):
            DevicePairs(Pictures(()), [apart], settings, no_keypoints, None, CPU)
        assert len(DevicePairs(Pictures((photographs(),)), [apart], settings, no_keypoints, None, CPU)[0]["valid"]) == 4


def test_pairs_of_the_same_scene_are_not_each_others_negatives() -> None:
    generator = torch.Generator().manual_seed(0)
    a = torch.nn.functional.normalize(torch.randn(4, 20, 16, generator=generator), dim=2)
    places = 100 * torch.rand(4, 20, 2, generator=generator)
    parts = (a, a, places, places, torch.ones(4, 20, dtype=torch.bool), torch.tensor(5.0), 8.0)
    alone = info_nce_loss(*parts)
    same = info_nce_loss(*parts, group=2, scenes=torch.tensor([0, 0, 3, 3]))
    other = info_nce_loss(*parts, group=2, scenes=torch.tensor([0, 1, 3, 4]))
    assert float(same) == pytest.approx(float(alone))
    assert float(other) > float(alone) + 0.1
    assert float(info_nce_loss(*parts, group=2)) == pytest.approx(float(other))


def test_what_is_held_costs_nothing_until_it_moves() -> None:
    logits = torch.randn(2, 65, 3, 4, generator=torch.Generator().manual_seed(0))
    assert float(held_loss(logits, logits)) == pytest.approx(0.0, abs=1e-6)
    assert float(held_loss(logits + 7, logits)) == pytest.approx(0.0, abs=1e-5)
    assert float(held_loss(2 * logits, logits)) > 0.05


def test_a_killed_training_ends_with_the_same_weights_and_holds_the_other_heads(tmp_path: Path) -> None:
    start, teacher = find_weights("superpoint-small"), find_weights("superpoint-vo")
    arguments = (Pictures((photographs(),)), [posed_room()])
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    row = train_held(*arguments, SMALL, whole, start, teacher, progress=False)
    with stopped_after(7):
        train_held(*arguments, SMALL, parts, start, teacher, progress=False)
    train_held(*arguments, SMALL, parts, start, teacher, progress=False)
    ends = [load_weights(folder / "weights.safetensors") for folder in (whole, parts)]
    assert all(np.array_equal(ends[0].tensors[name], ends[1].tensors[name]) for name in ends[0].tensors)
    assert ends[0].architecture.stability
    assert ends[0].card.training["stability_from"] == "superpoint-vo.safetensors"
    assert {"descriptor", "detector", "stability", "right"} <= row.keys()
    with pytest.raises(InputError, match="no stability head"):
        train_held(*arguments, SMALL, tmp_path / "other", start, start, progress=False)


def test_a_training_ends_when_its_time_is_up(tmp_path: Path) -> None:
    class Still(Stage):
        def __init__(self) -> None:
            super().__init__()
            self.network = torch.nn.Linear(2, 1)

        def losses(self, batch: Any) -> Any:
            time.sleep(0.004)
            return {"loss": self.network(batch["x"]).square().mean()}

    class Ones:
        def __len__(self) -> int:
            return 10**6

        def __getitem__(self, step: int) -> Any:
            return {"x": torch.ones(1, 2)}

    settings = replace(SMALL.optimiser, steps=10**6, decay_steps=10**6, log_every=10, checkpoint_minutes=1.0)
    trainer = Trainer(Still(), Ones(), settings, tmp_path, seconds=2.0)
    trainer.run(progress=False)
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert 1.0 < trainer.seconds < 4.0
    assert rows[-1]["step"] == trainer.step < 1000
    rates = [row["learning_rate"] for row in rows]
    assert rates[-1] < 0.05 * max(rates)
    assert (np.diff(rates) <= 1e-12).sum() > len(rates) // 2


def test_a_pack_gives_back_what_was_packed(tmp_path: Path) -> None:
    turning = replace(photographs(3), rotating=np.stack([np.eye(3)] * 3))
    room, data = posed_room(3), (DataSource("a room", "CC0 1.0", "nobody"),)
    write_pack(tmp_path / "pack.zip", Pictures((turning, photographs(2))), [room], data, quality=95)
    pictures, posed, licences = read_pack(tmp_path / "pack.zip")
    assert licences == data
    assert [len(source.pictures) for source in pictures.sources] == [3, 2]
    assert pictures.sources[0].rotating is not None
    assert pictures.sources[1].rotating is None
    assert np.abs(pictures.sources[0].pictures[1].astype(float) - turning.pictures[1]).mean() < 3
    assert posed[0].size == SIZE
    assert np.array_equal(posed[0].world_from_cam, room.world_from_cam)
    assert np.allclose(posed[0].inverse_depth[2], room.inverse_depth[2], atol=2e-4)
    assert pictures.skipped == posed[0].masks == pictures.sources[0].masks == ()
    (tmp_path / "other.zip").write_text("no")
    with pytest.raises(InputError, match="no pack"):
        read_pack(tmp_path / "other.zip")


def test_a_pack_keeps_masks_weights_and_names(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    source, room = photographs(2), replace(posed_room(3), weight=0.3)
    source = replace(source, names=("a.jpg", "b.jpg"), masks=tuple(rng.random((150, 200)) < 0.5 for _ in range(2)))
    room = replace(room, masks=tuple(rng.random((120, 160)) < 0.5 for _ in range(3)))
    write_pack(tmp_path / "pack.zip", Pictures((source, photographs(1)), ("broken.jpg",)), [room, posed_room(3)], ())
    pictures, posed, _ = read_pack(tmp_path / "pack.zip")
    assert pictures.skipped == ("broken.jpg",)
    assert [one.names for one in pictures.sources] == [("a.jpg", "b.jpg"), ("",)]
    assert [one.weight for one in posed] == [0.3, 1.0]
    for before, after in ((source, pictures.sources[0]), (room, posed[0])):
        assert all(mask.dtype == np.bool_ for mask in after.masks)
        np.testing.assert_array_equal(before.masks, after.masks)
    assert pictures.sources[1].masks == posed[1].masks == ()
    with pytest.raises(ValueError, match="zip"):
        write_pack(tmp_path / "wrong.zip", Pictures((replace(source, masks=source.masks[:1]),)), [], ())
    assert not (tmp_path / "wrong.zip").exists()


@pytest.mark.parametrize(
    "make",
    [
        lambda: DevicePairSettings(posed_share=1.5),
        lambda: DevicePairSettings(points=1),
        lambda: DevicePairSettings(largest_gap=0.0),
        lambda: HeldSettings(views=ViewSettings(height=100)),
        lambda: HeldSettings(optimiser=OptimiserSettings(batch_size=6, workers=0)),
        lambda: HeldSettings(optimiser=OptimiserSettings(batch_size=8, workers=1)),
        lambda: HeldSettings(stability_every=0),
        lambda: HeldSettings(scale=0.0),
        lambda: DevicePairSettings(whole_frames=-1),
    ],
)
def test_settings_out_of_range_are_refused(make: Any) -> None:
    with pytest.raises(ConfigError):
        make()


class Tracks:
    """Stands for `TrackedPairs`."""

    def __getitem__(self, step: int) -> dict[str, Any]:
        images = np.full((4, 1, 96, 128), step, np.uint8)
        points, known = np.ones((2, 64, 2), np.float32), np.ones((2, 64), np.bool_)
        return {"images": images, "points_a": points, "points_b": points, "valid": known, "negative": known, "cells": 0}


def test_tracks_take_turns_with_dense_pairs_and_are_held_to_the_same_teachers() -> None:
    settings = replace(SMALL, stability_every=2)

    def calm(views: Any, layers: int = 0) -> Any:
        return torch.zeros(len(views), 2, 12, 16), views

    dense = DevicePairs(Pictures(()), [posed_room()], settings, no_keypoints, calm, CPU)
    mixed = MixedPairs(dense, Tracks())  # type: ignore[arg-type]
    assert len(mixed) == len(dense) == 12
    even, odd = mixed[2], mixed[3]
    assert torch.equal(even["images"], dense[2]["images"])
    assert even.keys() | {"negative"} == odd.keys()
    assert (odd["images"] == 3).all()
    assert odd["detector"].shape == (4, 65, 12, 16)
    assert odd["stability"].shape == (2, 2, 12, 16)
    network = HeldStage(SuperPoint(replace(ARCHITECTURES["superpoint-small"], stability=True)), settings)
    batch = {**odd, "images": odd["images"].float() / 255}
    assert torch.isfinite(network.losses(batch)["loss"])


def test_statistics_stay_where_they_are_fixed(tmp_path: Path) -> None:
    start = find_weights("superpoint-small")
    before = load_weights(start).tensors
    for fixed in (True, False):
        out = tmp_path / str(fixed)
        settings = replace(SMALL, fixed_statistics=fixed)
        train_held(Pictures((photographs(),)), [posed_room()], settings, out, start, progress=False)
        after = load_weights(out / "weights.safetensors").tensors
        moved = {name for name, values in before.items() if not np.array_equal(values, after[name])}
        assert any(".running_" in name for name in moved) != fixed
        assert any(name.endswith("norm.weight") for name in moved)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_whole_frames_train_above_frozen_layers_in_either_precision(tmp_path: Path, precision: str) -> None:
    settings = replace(
        SMALL, frozen_layers=4, pairs=replace(SMALL.pairs, whole_frames=1, group=1),
        optimiser=replace(SMALL.optimiser, steps=3, precision=precision),
    )  # fmt: skip
    start = find_weights("superpoint-small")
    row = train_held(Pictures((photographs(),)), [posed_room()], settings, tmp_path / "out", start, progress=False)
    assert np.isfinite(row["loss"])


@pytest.mark.parametrize("frozen", [4, 8])
def test_frozen_layers_and_what_reads_only_them_stay_to_the_bit(tmp_path: Path, frozen: int) -> None:
    start = find_weights("superpoint-small")
    settings = replace(SMALL, frozen_layers=frozen)
    row = train_held(Pictures((photographs(),)), [posed_room()], settings, tmp_path / "out", start, progress=False)
    assert np.isfinite(row["loss"])
    before, after = load_weights(start).tensors, load_weights(tmp_path / "out" / "weights.safetensors").tensors
    changed = {name for name, values in before.items() if not np.array_equal(values, after[name])}
    kept = tuple(f"encoder.{layer}." for layer in range(frozen)) + (("detector.",) if frozen == 8 else ())
    assert not [name for name in changed if name.startswith(kept)]
    assert "descriptor.0.convolution.weight" in changed
    assert any(name.startswith("encoder.") for name in changed) == (frozen < 8)
    assert ("detector" in row) == (frozen < 8)


def test_no_pair_of_any_kind_has_a_point_on_a_masked_pixel() -> None:
    source, room = photographs(), posed_room()
    left = np.ones((150, 200), np.bool_)
    left[:, :90] = False
    below = np.ones((120, 160), np.bool_)
    below[70:] = False
    painted = tuple(np.where(left, np.maximum(picture, 80), np.uint8(0)) for picture in source.pictures)
    shown = tuple(np.where(below, np.maximum(picture, 80), np.uint8(0)) for picture in room.pictures)
    masked = replace(source, pictures=painted, masks=(left,) * len(painted))
    seen = replace(room, pictures=shown, masks=(below,) * len(shown))
    for two_frames, whole in ((True, 0), (False, 0), (True, 1)):
        pairs = replace(SMALL.pairs, two_frames=two_frames, whole_frames=whole, alone=20, largest_gap=6.0)
        batches = DevicePairs(Pictures((masked,)), [seen], replace(SMALL, pairs=pairs), no_keypoints, None, CPU)
        for step in range(3):
            batch = batches[step]
            count = len(batch["valid"])
            for pair, valid in enumerate(batch["valid"]):
                assert valid.any()
                taught = {"points_a": (pair, batch["negative"]), "points_b": (count + pair, batch["negative_b"])}
                for name, (image, used) in taught.items():
                    places = batch[name][pair][used[pair]].round().long()
                    assert (batch["images"][image, 0][places[:, 1], places[:, 0]] > 40).float().mean() > 0.98
