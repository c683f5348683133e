"""The descriptor metric of posed sequences made part of weights: no gradients, seconds instead of hours."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from improvo import config, files
from improvo.continuation import SettingsRecord
from improvo.frontend.architecture import CELL
from improvo.frontend.network import NetworkFrontend
from improvo.frontend.settings import NetworkSettings
from improvo.frontend.weights_files import DataSource, load_weights, save_weights
from improvo.training.augmentation.photometric import augment
from improvo.training.augmentation.views import inside, random_view, warp_image, warp_points
from improvo.training.batches.posed_frames import PosedFrames
from improvo.training.data.posed_sequence import PosedSequence, overlapping_pairs
from improvo.training.held_settings import DevicePairSettings
from improvo.training.metrics import METRICS, append_metrics, read_metrics
from improvo.training.output_folder import SETTINGS, WEIGHTS, commit_of_code, learned_from, not_stated, stage_folder
from improvo.training.settings import PhotometricSettings, ViewSettings
from improvo.training.stages.descriptor_metric import MetricSettings, Scatter, found_again, with_descriptor_map
from improvo.types import Features, Float64, Int64, Mask, UInt8

Pair = tuple[Features, Features, Int64]  # of two frames, and keypoints (K, 2) that show the same place
_DEPTH_TOLERANCE = 0.03  # of two frames' depths of a point, relative; beyond it something hides the point


def train_metric(
    posed: Sequence[PosedSequence],
    settings: MetricSettings,
    output: Path,
    start: Path,
    data: tuple[DataSource, ...] = (),
) -> dict[str, Any]:
    """Weights whose descriptors are mapped for these sequences; detector and stability are those of the start.

    Args:
        posed: sequences with poses and depth.
        settings: how.
        output: folder that gets `weights.safetensors` with its card, `settings.yaml` and `metrics.jsonl`.
        start: weights to start from.
        data: what the model card says about the sequences; their names where it is empty. The start's own is kept.

    Returns:
        `correspondences`, `pairs` and `seconds`.

    Raises:
        NoDescriptorMapError: too few keypoints were found again, or they say nothing.
        ConfigError: the folder was begun with other settings.
    """
    begun = time.monotonic()
    with stage_folder(output, "metric"):
        record, values = SettingsRecord(output / SETTINGS, MetricSettings, []), config.to_dict(settings)
        record.check(values, "give the same settings or another output folder")
        record.write(values)
        started_from = {"start": start.name, "start_sha256": files.content_hash(start)}
        rows = read_metrics(output / METRICS)
        if rows and _is_of(output / WEIGHTS, started_from):
            return rows[-1]
        weights = load_weights(start)
        frontend = NetworkFrontend(weights, NetworkSettings(max_keypoints=settings.max_keypoints))
        scatter, pairs = Scatter(weights.architecture.descriptor), 0
        make = _frame_pairs if settings.two_frames else _view_pairs
        for a, b, matches in make(posed, frontend, settings):
            if len(matches):
                scatter.add(a, b, matches, settings.masked_px)
            pairs += 1
        mapped = with_descriptor_map(weights, scatter.map(settings.shrinkage))
        row = {"step": pairs, "correspondences": scatter.count, "seconds": round(time.monotonic() - begun)}
        own = data or not_stated(sequence.name for sequence in posed)
        training = {
            **weights.card.training,
            "metric": {**started_from, "settings": values, "pairs": pairs, "correspondences": scatter.count},
        }
        # the map changes no activation, so that the ranges for int8 stay
        card = replace(
            weights.card, data=learned_from(weights.card.data, own), training=training, commit=commit_of_code()
        )
        files.write_text(output / METRICS, "")
        append_metrics(output / METRICS, row)
        save_weights(output / WEIGHTS, mapped.tensors, card)
    return row


def _is_of(path: Path, started_from: dict[str, str]) -> bool:
    """Whether the weights are there, and of this start."""
    if not path.is_file():
        return False
    made = load_weights(path).card.training.get("metric", {})
    return all(made.get(name) == value for name, value in started_from.items())


def _frame_pairs(posed: Sequence[PosedSequence], frontend: NetworkFrontend, settings: MetricSettings) -> Iterator[Pair]:
    """Two frames that show the same places, by depth and poses; classes of overlap are drawn evenly."""
    frames = PosedFrames(posed, torch.device("cpu"))
    pairs = [overlapping_pairs(sequence, DevicePairSettings()) for sequence in posed]
    useful = [number for number, found in enumerate(pairs) if found is not None]
    if not useful:
        return
    weights = np.array([posed[number].weight for number in useful])
    rng = np.random.default_rng(settings.seed)
    kept: dict[tuple[int, int], Features] = {}

    def features(number: int, frame: int) -> Features:
        if (number, frame) not in kept:
            sequence = posed[number]
            mask = sequence.masks[frame] if sequence.masks else None
            kept[number, frame] = frontend(sequence.pictures[frame], mask)
        return kept[number, frame]

    for _ in range(settings.pairs):
        number = int(rng.choice(useful, p=weights / weights.sum()))
        found = pairs[number]
        assert found is not None
        first, second = found.frames[found.draw_row(rng)].tolist()
        a, b = features(number, first), features(number, second)
        rows = frames.first[number] + np.array([[first, second]])
        in_a = torch.from_numpy(a.keypoints)[None]
        carried = frames.carry(rows, in_a, frames.depths.sample(rows[:, 0], in_a))
        shown = frames.shown(rows, carried, _DEPTH_TOLERANCE)[0].numpy()
        places = carried.places[0].numpy().astype(np.float64)
        yield a, b, found_again(b.keypoints, places, shown, settings.right_px)


def _view_pairs(posed: Sequence[PosedSequence], frontend: NetworkFrontend, settings: MetricSettings) -> Iterator[Pair]:
    """Frames and views of them under homographies and other light: the control, to which depth says nothing."""
    rng = np.random.default_rng(settings.seed)
    for sequence in posed:
        for frame, picture in enumerate(sequence.pictures):
            mask = sequence.masks[frame] if sequence.masks else None
            a = frontend(picture, mask)
            for _ in range(settings.views_per_frame):
                H, view, used = _view(picture, mask, rng)
                b = frontend(view, used)
                places = warp_points(H, a.keypoints.astype(np.float64))
                shown = inside(places, *view.shape[::-1])
                yield a, b, found_again(b.keypoints, np.nan_to_num(places, nan=-1e6), shown, settings.right_px)


def _view(picture: UInt8, mask: Mask | None, rng: np.random.Generator) -> tuple[Float64, UInt8, Mask]:
    """Homography, view, and which of its pixels show used ones of the picture."""
    height, width = picture.shape
    views = ViewSettings(
        height=height // CELL * CELL, width=width // CELL * CELL, smallest_zoom=0.6, largest_zoom=1.6,
        rotation_degrees=30.0,
    )  # fmt: skip
    H = random_view(rng, views, (width, height), np.array([width / 2, height / 2]))
    view = augment(np.asarray(warp_image(picture, H, views.width, views.height), np.uint8), rng, PhotometricSettings())
    y, x = np.mgrid[0 : views.height, 0 : views.width]
    back = warp_points(np.linalg.inv(H), np.stack([x, y], axis=-1).astype(np.float64))
    used = inside(back, width, height)
    if mask is not None:
        rows, columns = (np.where(used, back[..., axis], 0).round().astype(np.int64) for axis in (1, 0))
        used = used & mask[rows, columns]
    return H, view, used
