"""Training settings: every value that no stage knows is refused, and the message names the setting and its choices."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from improvo import config
from improvo.cli.main import main
from improvo.errors import ConfigError
from improvo.training import settings as training_settings
from improvo.training.held_settings import DevicePairSettings, HeldSettings
from improvo.training.settings import (
    AdaptationSettings,
    DetectorLossSettings,
    HomographiesSettings,
    LandmarkSettings,
    OdometryTrainingSettings,
    OptimiserSettings,
    PairSettings,
    PhotometricSettings,
    ShapesSettings,
    ViewSettings,
)

STAGES = (ShapesSettings, HomographiesSettings, OdometryTrainingSettings, HeldSettings)
WORDS = [
    (OptimiserSettings, "precision", "float16", "choose auto, float32 or bfloat16"),
    (OptimiserSettings, "device", "gpu", "choose auto, cpu, cuda or cuda:1"),
    (HomographiesSettings, "descriptor_loss", "typo", "choose info_nce or hinge"),
    (OdometryTrainingSettings, "descriptor_loss", "triplet", "choose info_nce or hinge"),
    (HomographiesSettings, "architecture", "resnet", "choose superpoint"),
    (ShapesSettings, "architecture", "", "choose superpoint"),
]
NUMBERS = [
    (OptimiserSettings, {"steps": 0}),
    (OptimiserSettings, {"batch_size": 0}),
    (OptimiserSettings, {"learning_rate": 0.0}),
    (OptimiserSettings, {"learning_rate": float("nan")}),
    (OptimiserSettings, {"clip_norm": float("inf")}),
    (OptimiserSettings, {"ema": 1.1}),
    (OptimiserSettings, {"workers": -1}),
    (OptimiserSettings, {"seed": -1}),
    (OptimiserSettings, {"log_every": 0}),
    (DetectorLossSettings, {"position_weight": -1.0}),
    (DetectorLossSettings, {"position_sigma": 0.0}),
    (ViewSettings, {"height": 100}),
    (ViewSettings, {"width": 8}),
    (ViewSettings, {"largest_zoom": 0.5}),
    (ViewSettings, {"rotation_degrees": 181.0}),
    (ViewSettings, {"stretch": -0.1}),
    (PhotometricSettings, {"contrast": (1.4, 0.5)}),
    (PhotometricSettings, {"gamma": (0.0, 1.0)}),
    (PhotometricSettings, {"jpeg_share": 1.5}),
    (PhotometricSettings, {"jpeg_quality": (40, 101)}),
    (PhotometricSettings, {"jpeg_quality": (40, 40)}),
    (AdaptationSettings, {"views": 0}),
    (AdaptationSettings, {"undecided": 0.5}),
    (HomographiesSettings, {"shapes_share": 1.0}),
    (HomographiesSettings, {"points": 1}),
    (HomographiesSettings, {"stem_channels": -1}),
    (LandmarkSettings, {"unstable_largest_step": 1.5}),
    (LandmarkSettings, {"largest_distance_ratio": 0.5}),
    (PairSettings, {"largest_gap": 0}),
    (PairSettings, {"wide_baselines": -0.5}),
    (PairSettings, {"replay_share": 1.2}),
    (PairSettings, {"least_points": -1}),
    (OdometryTrainingSettings, {"detector_weight": -0.1}),
    (OdometryTrainingSettings, {"longer_side": 8}),
    (OdometryTrainingSettings, {"negatives_across": True, "descriptor_loss": "hinge"}),
    (DevicePairSettings, {"keypoint_share": -0.1}),
    (HeldSettings, {"stability_every": 0}),
]


@pytest.mark.parametrize(("kind", "name", "value", "mend"), WORDS)
def test_an_unknown_word_is_refused_with_the_choices(kind: Any, name: str, value: str, mend: str) -> None:
    with pytest.raises(ConfigError, match=f"{name}`: `{value}` is unknown; {mend}"):
        kind(**{name: value})


@pytest.mark.parametrize(("kind", "values"), NUMBERS, ids=lambda value: getattr(value, "__name__", str(value)))
def test_a_number_out_of_range_is_refused_by_name(kind: Any, values: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(values))):
        kind(**values)


@pytest.mark.parametrize("stage", STAGES)
def test_defaults_are_good_and_every_group_is_checked(stage: type) -> None:
    settings = stage()
    assert config.from_dict(stage, config.to_dict(settings)) == settings
    for group in vars(training_settings).values():
        if dataclasses.is_dataclass(group) and group.__module__ == training_settings.__name__:
            assert "__post_init__" in vars(group), group


def test_a_stage_has_no_section_that_does_nothing_in_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "train-shapes"]) == 0
    assert "adaptation" not in capsys.readouterr().out
    assert main(["config", "train-homographies"]) == 0
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    for name, comment in (("accepted", "is a label"), ("undecided", "is neither label nor background")):
        (row,) = (number for number, line in enumerate(lines) if line.startswith(f"{name}:"))
        assert comment in " ".join(lines[row - 1 : row + 1])


def test_a_setting_of_a_section_is_named_once() -> None:
    with pytest.raises(ConfigError) as error:
        config.load(OdometryTrainingSettings, None, ["optimiser.precision=half"])
    assert str(error.value) == "settings: setting `optimiser.precision`: `half` is unknown; choose " + (
        "auto, float32 or bfloat16"
    )


@pytest.mark.parametrize("device", ["auto", "cpu", "cuda", "cuda:0", "cuda:3"])
def test_devices_that_torch_may_have_are_known(device: str) -> None:
    assert OptimiserSettings(device=device).device == device


def test_the_former_name_of_replay_is_read() -> None:
    settings = config.load(OdometryTrainingSettings, None, ["pairs.rehearsed_share=0.25"])
    assert settings.pairs.replay_share == 0.25
    assert config.from_dict(OdometryTrainingSettings, {"pairs": {"rehearsed_share": 0.125}}).pairs.replay_share == 0.125
