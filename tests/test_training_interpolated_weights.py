"""Weights between those that a training began with and those that it ended with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from improvo import files
from improvo.errors import ConfigError, InputError
from improvo.frontend.channel_pruning import with_dead_channels
from improvo.frontend.weights_files import Weights, find_weights, load_weights, save_weights
from improvo.improvement.recipe import stages
from improvo.improvement.settings import HELD, METRIC, TRACKS, ImproveSettings
from improvo.training.interpolated_weights import interpolated, write_interpolated

START = find_weights("superpoint-small")


def trained_from(start: Weights, scale: float = 1.5) -> Weights:
    return Weights(start.card, {name: np.float32(scale) * values for name, values in start.tensors.items()})


def test_every_tensor_lies_so_far_along_the_way() -> None:
    start = load_weights(START)
    trained = trained_from(start)
    for share in (0.25, 0.5, 1.0):
        found = interpolated(start, trained, share)
        assert found.tensors.keys() == start.tensors.keys()
        for name, values in found.tensors.items():
            np.testing.assert_allclose(values, (1 + 0.5 * share) * start.tensors[name], rtol=1e-5)
    assert start.card.activation_ranges
    assert not found.card.activation_ranges  # which are those of other activations


def test_channels_that_one_of_the_files_has_at_another_place_are_the_same_channels() -> None:
    small, wide = load_weights(START), load_weights(find_weights("superpoint")).architecture
    first = tuple(small.architecture.encoder)
    padded = replace(small.architecture, encoder=(first[0] + 8, *first[1:]))
    start = Weights(replace(small.card, architecture=padded), with_dead_channels(small.tensors, padded))
    order = np.roll(np.arange(first[0] + 8), 8)  # the dead ones come first
    moved = dict(start.tensors)
    for name, values in start.tensors.items():
        if name.startswith("encoder.0."):
            moved[name] = values[order]
    moved["encoder.1.convolution.weight"] = start.tensors["encoder.1.convolution.weight"][:, order]
    found = interpolated(Weights(start.card, moved), start, 0.5)
    for name, values in found.tensors.items():
        np.testing.assert_allclose(values, start.tensors[name], atol=1e-6)
    assert wide.encoder[0] > first[0]
    with pytest.raises(InputError, match="nothing lies between"):
        interpolated(small, load_weights(find_weights("superpoint")), 0.5)


def test_the_card_says_what_they_are_the_mean_of(tmp_path: Path) -> None:
    start = load_weights(START)
    trained = tmp_path / "trained.safetensors"
    save_weights(trained, trained_from(start).tensors, replace(start.card, training={"stage": "held", "steps": 300}))
    for name in ("a", "b"):
        write_interpolated([(START, 0.7)], trained, tmp_path / f"{name}.safetensors")
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
    card = load_weights(tmp_path / "a.safetensors").card
    assert card.training["steps"] == 300
    assert card.training["interpolated"] == [
        {"start": START.name, "start_sha256": files.content_hash(START), "share": 0.7}
    ]
    assert card.data == start.card.data


def test_a_second_start_is_further_back(tmp_path: Path) -> None:
    start = load_weights(START)
    before, trained, out = (tmp_path / f"{name}.safetensors" for name in ("before", "trained", "out"))
    save_weights(before, trained_from(start, 1.5).tensors, start.card)
    save_weights(trained, trained_from(start, 2.0).tensors, start.card)
    write_interpolated([(before, 0.8), (START, 0.9)], trained, out)
    found = load_weights(out)
    for name, values in found.tensors.items():  # 0.8 of the way from 1.5 to 2 is 1.9; then 0.9 of that from 1
        np.testing.assert_allclose(values, 1.81 * start.tensors[name], rtol=1e-5)
    assert [each["share"] for each in found.card.training["interpolated"]] == [0.8, 0.9]


def test_the_default_goes_part_of_the_way_and_the_other_recipes_all_of_it() -> None:
    assert stages(ImproveSettings()) == (HELD, METRIC, "part-way")
    assert stages(ImproveSettings(way=1.0, later_way=1.0)) == (HELD, METRIC)
    assert stages(ImproveSettings(then_metric=False)) == (HELD, "part-way")
    assert stages(ImproveSettings(recipe=METRIC)) == (METRIC,)
    assert stages(ImproveSettings(recipe=TRACKS)) == (TRACKS,)
    for way in (0.0, 1.1, float("nan")):
        with pytest.raises(ConfigError, match="way="):
            ImproveSettings(way=way)
        with pytest.raises(ConfigError, match="later_way="):
            ImproveSettings(later_way=way)
