"""The trainer and the stages: seeds, continuing, divergence, losses, widening, and the commands."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs the extra `train`")

from improvo.cli.main import main  # noqa: E402
from improvo.frontend.architecture import ARCHITECTURES, Architecture  # noqa: E402
from improvo.frontend.superpoint import SuperPoint  # noqa: E402
from improvo.frontend.weights_files import load_weights  # noqa: E402
from improvo.training.batches.drawn_shapes import ShapeBatches, shape_source  # noqa: E402
from improvo.training.batches.homography_pairs import PairBatches  # noqa: E402
from improvo.training.settings import HomographiesSettings, OptimiserSettings, ShapesSettings, ViewSettings  # noqa: E402
from improvo.training.stages.losses import detector_loss, hinge_loss, info_nce_loss  # noqa: E402
from improvo.training.stages.superpoint import JointStage, MagicPointStage  # noqa: E402
from improvo.training.trainer import DivergedError, Trainer  # noqa: E402
from improvo.training.widen import widen  # noqa: E402

TINY = Architecture("tiny", encoder=(4, 4, 4, 4, 8, 8, 8, 8), head=8, descriptor=8, stability=False)
VIEWS = ViewSettings(height=48, width=64)


def optimiser(**changes: Any) -> OptimiserSettings:
    values = {"steps": 50, "batch_size": 2, "warmup_steps": 5, "decay_steps": 10, "threads": 1, "workers": 0}
    return OptimiserSettings(**{**values, "log_every": 5, "checkpoint_minutes": 0.0, **changes})


def joint(folder: Path, **changes: Any) -> Trainer:
    from improvo.training.data.pictures import Pictures

    folder.mkdir(exist_ok=True)
    source, labels = shape_source(9, 1, 1.0)
    settings = HomographiesSettings(optimiser=optimiser(**changes), views=VIEWS, points=32)
    torch.manual_seed(settings.optimiser.seed)
    stage = JointStage(SuperPoint(TINY), settings)
    return Trainer(stage, PairBatches(Pictures((source,)), [labels], settings), settings.optimiser, folder)


def losses_of(folder: Path) -> list[float]:
    return [json.loads(row)["loss"] for row in (folder / "metrics.jsonl").read_text().splitlines()]


def state(network: torch.nn.Module) -> dict[str, np.ndarray]:
    return {name: value.numpy() for name, value in network.state_dict().items()}


def test_same_seed_same_curve_and_it_falls(tmp_path: Path) -> None:
    one = state(joint(tmp_path / "one").run(progress=False))
    two = state(joint(tmp_path / "two").run(progress=False))
    joint(tmp_path / "other", seed=1, steps=10).run(progress=False)
    curve = losses_of(tmp_path / "one")
    assert len(curve) == 10
    assert curve == losses_of(tmp_path / "two")
    assert all(np.array_equal(one[name], two[name]) for name in one)
    assert losses_of(tmp_path / "other")[0] != curve[0]
    assert np.mean(curve[-3:]) < 0.9 * curve[0]


def test_more_steps_than_first_planned_go_on_where_it_ended(tmp_path: Path) -> None:
    joint(tmp_path / "long", steps=8).run(progress=False)
    longer = joint(tmp_path / "long", steps=10)
    assert longer.resume()
    longer.run(progress=False)
    curve = losses_of(tmp_path / "long")
    assert len(curve) == 3  # after steps 5, 8 and 10
    assert max(curve) < 1.5 * min(curve)  # each is a mean over its own steps


@pytest.mark.parametrize("killed_at", [7, 33])
def test_a_killed_training_ends_as_one_that_was_not(tmp_path: Path, killed_at: int) -> None:
    whole = state(joint(tmp_path / "whole").run(progress=False))

    class Killed:
        def __init__(self, batches: Any) -> None:
            self.batches = batches

        def __len__(self) -> int:
            return len(self.batches)

        def __getitem__(self, step: int) -> dict[str, np.ndarray]:
            if step == killed_at:
                raise KeyboardInterrupt
            return self.batches[step]

    trainer = joint(tmp_path / "killed")
    trainer.batches = Killed(trainer.batches)
    with pytest.raises(KeyboardInterrupt):
        trainer.run(progress=False)
    # what was written behind the last checkpoint is of no consequence
    with (tmp_path / "killed" / "metrics.jsonl").open("a") as stream:
        stream.write(json.dumps({"step": killed_at, "loss": 99.0}) + "\n")

    continued = joint(tmp_path / "killed")
    assert continued.resume()
    assert continued.step == killed_at // 5 * 5
    ended = state(continued.run(progress=False))
    assert all(np.array_equal(whole[name], ended[name]) for name in whole)
    assert losses_of(tmp_path / "killed") == losses_of(tmp_path / "whole")


def test_workers_do_not_change_the_batches(tmp_path: Path) -> None:
    alone = state(joint(tmp_path / "alone", steps=6).run(progress=False))
    helped = state(joint(tmp_path / "helped", steps=6, workers=2).run(progress=False))
    assert all(np.array_equal(alone[name], helped[name]) for name in alone)


def test_a_loss_that_is_no_number_stops_with_the_step(tmp_path: Path) -> None:
    trainer = joint(tmp_path / "nan")
    trainer.run(progress=False)
    kept = (tmp_path / "nan" / "checkpoint.pt").read_bytes()
    again = joint(tmp_path / "nan", steps=70)
    assert again.resume()
    with torch.no_grad():
        next(again.stage.parameters()).fill_(float("nan"))
    with pytest.raises(DivergedError, match=r"nan at step 55.*learning_rate"):
        again.run(progress=False)
    assert (tmp_path / "nan" / "checkpoint.pt").read_bytes() == kept


def test_the_shapes_stage_leaves_the_descriptor_alone(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = SuperPoint(TINY)
    before = {name: value.clone() for name, value in network.descriptor.state_dict().items()}
    settings = ShapesSettings(optimiser=optimiser(steps=60, batch_size=8, learning_rate=1e-2), views=VIEWS)
    Trainer(MagicPointStage(network), ShapeBatches(settings), settings.optimiser, tmp_path).run(progress=False)
    assert all(torch.equal(value, before[name]) for name, value in network.descriptor.state_dict().items())
    curve = losses_of(tmp_path)
    assert np.mean(curve[-3:]) < 0.9 * np.mean(curve[:3])


def test_ignored_cells_do_not_teach() -> None:
    logits = torch.zeros(1, 65, 2, 2, requires_grad=True)
    cells = torch.tensor([[[3, -1], [64, -1]]])
    loss = detector_loss(logits, cells)
    loss.backward()
    assert loss.item() == pytest.approx(np.log(65), rel=1e-5)
    assert logits.grad is not None
    assert (logits.grad[0, :, :, 1] == 0).all()
    assert (logits.grad[0, :, :, 0] != 0).all()


def test_info_nce_prefers_the_partner_and_spares_neighbours() -> None:
    descriptors = torch.eye(4)[None]
    points = torch.tensor([[[0.0, 0], [20, 0], [40, 0], [43, 0]]])
    valid = torch.ones(1, 4, dtype=torch.bool)
    scale = torch.tensor(10.0)
    matched = info_nce_loss(descriptors, descriptors, points, points, valid, scale, 8.0)
    swapped = info_nce_loss(descriptors, descriptors[:, [1, 0, 2, 3]], points, points, valid, scale, 8.0)
    neighbours = info_nce_loss(descriptors, descriptors[:, [0, 1, 3, 2]], points, points, valid, scale, 0.0)
    assert matched < 0.01
    assert swapped > 4
    assert neighbours > 4
    same = torch.eye(3)[[0, 1, 2, 2]][None]  # the two neighbours look alike: no loss, they are not negatives
    assert info_nce_loss(same, same, points, points, valid, scale, 8.0) < 0.01
    valid[0, 1] = False
    assert info_nce_loss(descriptors, descriptors, points, points, valid, scale, 8.0) < 0.01


def test_hinge_loss_is_the_papers() -> None:
    centres = torch.tensor([[3.5, 3.5], [3.5 + 80, 3.5]])
    valid = torch.ones(1, 2, dtype=torch.bool)
    one = torch.eye(2)[None]
    assert hinge_loss(one, one, centres[None], centres, valid).item() == pytest.approx(0.0)
    swapped = hinge_loss(one, one.flip(1), centres[None], centres, valid)
    # two positives at 250 * (1 - 0) and two negatives at (1 - 0.2), over 2 cells times 2 cells
    assert swapped.item() == pytest.approx((2 * 250 + 2 * 0.8) / 4)


def test_a_widened_network_computes_the_same() -> None:
    torch.manual_seed(3)
    small = replace(ARCHITECTURES["superpoint-small"], stability=False)
    large = replace(ARCHITECTURES["superpoint"], stability=False)
    narrow = SuperPoint(small)
    images = torch.rand(4, 1, 48, 64)
    for _ in range(3):
        narrow(images)  # batch-norm statistics other than the first
    wide = SuperPoint(large)
    wide.load_state_dict(
        {
            name: torch.from_numpy(values)
            for name, values in widen(state(narrow), small, large, np.random.default_rng(0)).items()
        },
        strict=False,
    )
    before, after = narrow.eval()(images), wide.eval()(images)
    assert torch.allclose(before.detector_logits, after.detector_logits, atol=1e-4)
    a, b = (torch.nn.functional.normalize(output.descriptors, dim=1).flatten(2) for output in (before, after))
    assert torch.allclose(a.transpose(1, 2) @ a, b.transpose(1, 2) @ b, atol=1e-4)
    halves = wide.encoder[2].convolution.weight[:32, :32], wide.encoder[2].convolution.weight[:32, 32:]
    assert not torch.allclose(*halves)  # the copies can part ways


def test_views_made_in_a_batch_are_those_made_one_by_one() -> None:
    from improvo.training.augmentation.views import random_view, warp_image
    from improvo.training.data.homographic_adaptation import warp_batch

    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.uniform(0, 255, (96, 128)).astype(np.float32), (0, 0), 3)
    homographies = np.stack([random_view(rng, VIEWS, (128, 96)) for _ in range(5)])
    together = warp_batch(torch.from_numpy(picture), homographies, (64, 48))[:, 0].numpy()
    for view, H in zip(together, homographies, strict=True):
        seen = warp_image(np.ones_like(picture), H, 64, 48) > 0.999
        assert np.abs(view - warp_image(picture, H, 64, 48))[seen][20:].mean() < 0.5


def test_adaptation_finds_the_corners_of_a_board() -> None:
    from improvo.training.data.homographic_adaptation import adapt, shi_tomasi
    from improvo.training.data.pictures import Pictures, Source
    from improvo.training.settings import AdaptationSettings

    y, x = np.mgrid[0:240, 0:320]
    board = np.where((x // 40 + y // 40) % 2, 40, 210).astype(np.uint8)
    corners = np.stack(np.meshgrid(np.arange(1, 8), np.arange(1, 6)), axis=-1).reshape(-1, 2) * 40 - 0.5
    picture = cv2.GaussianBlur(board, (0, 0), 0.8)
    settings = AdaptationSettings()
    pictures = Pictures((Source("board", (picture,), ("board",), 1.0),))
    labels = adapt(pictures, shi_tomasi(), settings, ViewSettings(), seed=0, progress=False)[0][0]
    accepted = labels.points[labels.agreement >= settings.accepted]
    gaps = np.linalg.norm(corners[:, None] - accepted[None], axis=2)
    assert (gaps.min(axis=1) <= 1.5).mean() > 0.8
    assert (gaps.min(axis=0) <= 1.5).mean() > 0.9


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    folder = tmp_path / "photographs"
    folder.mkdir()
    source, _ = shape_source(6, 2, 1.0)
    for name, picture in zip(source.names, source.pictures, strict=True):
        cv2.imwrite(str(folder / f"{name}.png"), picture)
    return folder


QUICK = ("--steps", "6", "--batch-size", "2", "--workers", "0", "--threads", "1", "--architecture", "superpoint-small")
QUICK += ("--set", "views.height=48", "--set", "views.width=64", "--set", "optimiser.log_every=2")


def test_the_commands_go_from_shapes_to_a_second_round(
    tmp_path: Path, photographs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (photographs / "broken.png").write_bytes(b"no picture")
    assert main(["train", "shapes", "-o", str(tmp_path / "shapes"), *QUICK, "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["weights"] == str(tmp_path / "shapes" / "weights.safetensors")
    assert np.isfinite(figures["loss"])
    few = [*QUICK, "--set", "adaptation.views=6", "--set", "shapes=9"]
    first = ["train", "homographies", str(photographs), "-o", str(tmp_path / "first"), *few]
    assert main([*first, "--from", str(tmp_path / "shapes" / "weights.safetensors")]) == 0
    told = capsys.readouterr().out
    assert "broken.png" in told
    assert "1 pictures skipped, 6 read" in told
    card = load_weights(tmp_path / "first" / "weights.safetensors").card
    assert card.training["steps"] == 6
    assert card.training["start"] == "weights.safetensors"
    assert card.training["pictures_skipped"] == 1
    assert card.training["stability_trained"] is False
    assert [source.name for source in card.data] == ["photographs", "procedural shapes"]
    rows = [json.loads(row) for row in (tmp_path / "first" / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [2, 4, 6]
    assert all(0 <= row["loading_share"] <= 1 for row in rows)

    second = ["train", "homographies", str(photographs), "-o", str(tmp_path / "second"), *few]
    second += ["--detector", str(tmp_path / "first" / "weights.safetensors"), "--descriptor-loss", "hinge"]
    # a detector of six steps is unsure of everything: whatever it finds, the command ends with weights or says why
    status = main([*second, "--set", "adaptation.undecided=0.01"])
    assert (status == 0) == (tmp_path / "second" / "weights.safetensors").is_file()
    assert status in (0, 2)


def test_a_finished_folder_is_left_as_it_is_and_other_settings_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["train", "shapes", "-o", str(tmp_path / "shapes"), *QUICK]
    assert main(command) == 0
    weights = (tmp_path / "shapes" / "weights.safetensors").read_bytes()
    assert main(command) == 0
    assert (tmp_path / "shapes" / "weights.safetensors").read_bytes() == weights
    capsys.readouterr()
    assert main([*command, "--seed", "4"]) == 2
    assert "was begun with --seed 0, now with --seed 4" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("extra", "told"),
    [
        (["--architecture", "resnet"], "resnet"),
        (["--from", "nowhere.safetensors"], "nowhere.safetensors"),
        (["--set", "optimiser.stepps=3"], "stepps"),
    ],
)
def test_mistakes_are_one_line(extra: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "shapes", "-o", str(tmp_path / "out"), *QUICK, *extra]) == 2
    message = capsys.readouterr().err.strip()
    assert told in message
    assert "\n" not in message


def test_an_empty_folder_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    assert main(["train", "homographies", str(empty), "-o", str(tmp_path / "out"), *QUICK]) == 2
    assert "has no pictures" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
