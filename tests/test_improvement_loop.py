"""The loop: what it trains on, what it keeps, and that nothing is lost when it is stopped."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from rendered_walk import write_walk

from improvement_example import SETTINGS, FakeTraining, run
from improvo import config
from improvo.errors import ConfigError, ImprovoError, InputError, OutputError
from improvo.frontend.weights_files import find_weights, load_weights, save_weights
from improvo.improvement import improve as loop
from improvo.improvement.decision import rule, why_not_better
from improvo.improvement.folder import Candidate
from improvo.improvement.improve import Improvement
from improvo.improvement.progress import ImprovementProgress
from improvo.improvement.recipe import TrainingJob
from improvo.improvement.rounds import Rounds
from improvo.improvement.settings import ImproveSettings, SplitSettings, ValidationSettings
from improvo.improvement.split import Part
from improvo.improvement.validation import GapScores, Validation, gain, read_validation, summary
from improvo.labeling.labeled import read_labels

EXAMPLE = Path(__file__).with_name("improvement_example.py")
LABEL_TABLES = ("tracks.parquet", "points.parquet", "frames.parquet", "trajectory.txt")


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 40 frames."""
    return write_walk(tmp_path_factory.mktemp("walk") / "room", frames=40, seed=3)


@pytest.fixture(scope="module")
def finished(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Improvement, FakeTraining, list[str]]:
    """Two rounds on it: the first mends spoiled weights, the second ruins them."""
    training, lines = FakeTraining(), list[str]()
    out = tmp_path_factory.mktemp("improve") / "out"
    return run(out, [walk], training, progress=ImprovementProgress(lines.append)), training, lines


def starting(name: str) -> ImproveSettings:
    """The settings with another frontend at the start."""
    return replace(SETTINGS, frontend=replace(SETTINGS.frontend, name=name))


def results(out: Path) -> dict[str, object]:
    """All that the loop is for: labels and splits byte for byte, tensors, and what was measured but for seconds."""
    found: dict[str, object] = {
        str(path.relative_to(out)): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.name in (*LABEL_TABLES, "split.json") and "training" not in path.parts
    }
    for path in sorted(out.rglob("weights.safetensors")):
        for name, value in load_weights(path).tensors.items():
            found[f"{path.relative_to(out)}:{name}"] = value.tobytes()
    for path in sorted(out.rglob("judgement.json")):
        found[str(path.relative_to(out))] = {**json.loads(path.read_text()), "seconds": {}, "failures": []}
    return found


def test_training_never_sees_what_is_held_back(finished: tuple[Improvement, FakeTraining, list[str]]) -> None:
    result, training, _ = finished
    assert len(training.calls) == 2
    for call in training.calls:
        (store,) = call["labels"]
        (labelled,) = read_labels(store)
        assert labelled.frames.source_index.tolist() == list(range(28))
        assert labelled.settings.end == 28
        (seen,) = call["seen"]  # with depth, which was made from frames of this part alone
        assert len(seen) >= 20
        assert max(seen) < 28
    for candidate in result.candidates[:2]:  # the last is too bad to track anything
        (judged,) = read_labels(candidate.held_back)
        assert judged.frames.source_index.tolist() == list(range(28, 40))


def test_the_best_weights_are_kept_and_the_report_is_there(
    finished: tuple[Improvement, FakeTraining, list[str]],
) -> None:
    result, training, lines = finished
    scores = [validation.mean("right_8px") for validation in result.validations]
    assert scores[2] < scores[0] < scores[1]
    assert result.best == 1
    kept, chosen = load_weights(result.weights), load_weights(result.candidates[1].weights)
    for name, tensor in chosen.tensors.items():
        np.testing.assert_array_equal(kept.tensors[name], tensor)
    assert kept.card.metrics["improvement"]["kept"] == "round 1"
    assert kept.card.activation_ranges == chosen.card.activation_ranges
    assert all(load_weights(candidate.weights).card.activation_ranges for candidate in result.candidates)
    # every round learns from the best before it, and the second try is another one
    assert [call["start"] for call in training.calls] == [candidate.weights for candidate in result.candidates[:2]]
    assert [call["seed"] for call in training.calls] == [0, 1]
    page = (result.weights.parent / "report.html").read_text()
    assert rule(SETTINGS.validation) in page
    assert "the last 12 of 40 frames of room" in page
    assert "Kept: round 1; " in page
    assert result.faults[:2] == ("", "")
    assert result.kept == (1,)
    assert f"Round 2 is not kept: {result.faults[2]}. Against the start: " in page
    assert page.count("data:image/png") == 4  # matches and labels of the start and of the best
    assert any(line.startswith("round 1: ") and line.endswith("better, kept") for line in lines)
    assert any(line.startswith("round 2: ") and line.endswith("), not kept") for line in lines)


def test_no_better_round_leaves_the_start_and_says_so(walk: Path, tmp_path: Path) -> None:
    result = run(tmp_path / "out", [walk], FakeTraining((0.5,)), rounds=1)
    assert result.best == 0
    kept, start = load_weights(result.weights), load_weights(result.candidates[0].weights)
    assert all(np.array_equal(kept.tensors[name], tensor) for name, tensor in start.tensors.items())
    assert "No round was better than the start" in (tmp_path / "out" / "report.html").read_text()


def test_a_finished_run_is_left_as_it_is_and_more_rounds_go_on_from_it(
    walk: Path, finished: tuple[Improvement, FakeTraining, list[str]]
) -> None:
    result, _, _ = finished
    out = result.weights.parent
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file() and path.suffix != ".yaml"}
    again = FakeTraining()
    assert run(out, [walk], again, rounds=1).best == result.best  # fewer rounds do not undo the others
    assert again.calls == []
    changed = {path.name for path, when in before.items() if path.stat().st_mtime_ns != when}
    assert changed <= {".improvo.json", ".improvo.lock", "report.html"}


def test_other_settings_are_refused_and_what_a_kill_left_is_cleared_away(
    walk: Path, finished: tuple[Improvement, FakeTraining, list[str]], tmp_path: Path
) -> None:
    out = finished[0].weights.parent
    training = replace(SETTINGS.held, descriptor_weight=2.0)
    with pytest.raises(ConfigError, match=r"begun with held.descriptor_weight=1.0, now 2.0"):
        run(out, [walk], FakeTraining(), settings=replace(SETTINGS, held=training))
    with pytest.raises(ConfigError, match="frontend"):
        run(out, [walk], FakeTraining(), settings=starting("superpoint"))
    with pytest.raises(ConfigError, match="sequences"):
        run(out, [tmp_path], FakeTraining())
    with pytest.raises(ConfigError, match="has no weights to train"):
        run(out, [walk], FakeTraining(), settings=starting("orb"))
    leftovers = [out / "round-1" / "held-back" / ".room.partial" / ".points.parquet.1.partial.parquet"]
    leftovers += [leftovers[0].with_name("frames.parquet"), out / ".weights.safetensors.1.partial.safetensors"]
    leftovers[0].parent.mkdir()
    for leftover in leftovers:
        leftover.touch()
    free = replace(SETTINGS.held, optimiser=replace(SETTINGS.held.optimiser, threads=1, log_every=3))
    run(out, [walk], FakeTraining(), settings=replace(SETTINGS, held=free))
    assert not any(leftover.exists() for leftover in leftovers)


def test_a_folder_begun_when_a_fifth_was_the_default_goes_on_with_its_split(walk: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    begun = replace(SETTINGS, split=SplitSettings(0.2))
    run(out, [walk], FakeTraining(), 1, settings=begun)
    split = (out / "split.json").read_bytes()
    values = yaml.safe_load((out / "settings.yaml").read_text())
    del values["split"]["least_frames"]  # as it was then
    (out / "settings.yaml").write_text(yaml.safe_dump(values))
    for _ in range(2):
        run(out, [walk], FakeTraining(), 1, settings=replace(SETTINGS, split=SplitSettings()))
        assert (out / "split.json").read_bytes() == split
    run(out, [walk], FakeTraining(), 1, settings=begun)
    with pytest.raises(ConfigError, match=r"begun with split.share=0.2, now 0.3"):
        run(out, [walk], FakeTraining(), 1)


def test_a_folder_of_a_former_version_is_refused_for_what_it_is(
    walk: Path, finished: tuple[Improvement, FakeTraining, list[str]], tmp_path: Path
) -> None:
    shutil.copytree(finished[0].weights.parent, tmp_path / "out")
    path = tmp_path / "out" / "settings.yaml"
    values = yaml.safe_load(path.read_text())
    del values["reference"], values["recipe"]
    path.write_text(yaml.safe_dump(values))
    with pytest.raises(ConfigError, match="an earlier version, which measured otherwise"):
        run(path.parent, [walk], FakeTraining())


def test_the_control_is_judged_like_a_round_and_never_kept(walk: Path, tmp_path: Path) -> None:
    training, lines = FakeTraining((0.0,)), list[str]()
    out = tmp_path / "out"
    settings = replace(SETTINGS, control=True)
    result = run(out, [walk], training, rounds=1, settings=settings, progress=ImprovementProgress(lines.append))
    assert [call["control"] for call in training.calls] == [False, True]
    assert training.calls[0]["seen"] == training.calls[1]["seen"]
    assert [call["steps"] for call in training.calls] == [0, 3]  # as many as the round took
    assert result.control is not None
    control, validation = result.control
    assert control.weights == out / "control-1" / "weights.safetensors"
    assert [scores.pairs for scores in validation.scores] == [scores.pairs for scores in result.validations[0].scores]
    assert result.candidates[result.best].name == "round 1"
    assert any(line.startswith("control: ") and not line.endswith("kept") for line in lines)
    assert "The control, trained for as many rounds and steps" in (out / "report.html").read_text()
    again = FakeTraining()
    assert run(out, [walk], again, rounds=1, settings=SETTINGS).control is None  # it may be left out or added
    assert again.calls == []


def test_the_control_has_as_many_rounds_and_steps_as_what_is_kept(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    verdicts = iter(["", "", "a fault"])
    monkeypatch.setattr("improvo.improvement.improve.why_not_better", lambda *_: next(verdicts))
    training, out = FakeTraining((0.0,)), tmp_path / "out"
    settings = replace(SETTINGS, control=True)
    result = run(out, [walk], training, rounds=3, settings=settings)
    assert result.kept == (1, 2)  # and the third was refused
    assert [call["control"] for call in training.calls] == [False] * 3 + [True] * 2
    assert [call["steps"] for call in training.calls[3:]] == [3, 3]  # those of either round
    assert [call["seed"] for call in training.calls[3:]] == [0, 1]
    start = result.candidates[0]
    assert [call["start"] for call in training.calls[3:]] == [start.weights, out / "control-1" / "weights.safetensors"]
    # every later one, control or not, goes back towards the start
    assert [call["first"] for call in training.calls] == [None, start.weights, start.weights, None, start.weights]
    assert result.control is not None
    assert result.control[0].name == "control, 2 rounds"
    assert not (out / "control-1" / "judgement.json").exists()


def test_by_itself_the_loop_ends_with_the_first_round_that_is_not_better(walk: Path, tmp_path: Path) -> None:
    training, lines = FakeTraining((0.5,)), list[str]()
    out = tmp_path / "out"
    result = run(out, [walk], training, rounds=None, progress=ImprovementProgress(lines.append))
    assert [candidate.name for candidate in result.candidates] == ["start", "round 1"]
    assert result.kept == ()
    assert any(line.startswith("estimate: ") and line.endswith("a round, up to 2 rounds") for line in lines)
    assert lines[-1] == "no further round, since the last was not better; --rounds 2 tries once more"
    again = FakeTraining()
    assert run(out, [walk], again, rounds=None).kept == ()
    assert again.calls == []
    assert run(out, [walk], FakeTraining((0.5, 0.0)), rounds=2).kept == (2,)  # asked for, it tries
    assert run(out, [walk], again, rounds=None).kept == (2,)  # and all of it is read again
    assert again.calls == []


def test_by_itself_it_makes_two_rounds_where_the_first_is_better(
    walk: Path, finished: tuple[Improvement, FakeTraining, list[str]], tmp_path: Path
) -> None:
    assert len(run(tmp_path / "out", [walk], FakeTraining(), rounds=None).candidates) == 3
    assert results(tmp_path / "out") == results(finished[0].weights.parent)


def test_of_several_sequences_whole_ones_are_held_back_and_bad_ones_are_named(walk: Path, tmp_path: Path) -> None:
    good = [walk, write_walk(tmp_path / "hall", frames=30, seed=1)]
    black, dark, short, cut = (tmp_path / name for name in ("black", "dark", "short", "cut"))
    for folder, frames in ((black, 12), (dark, 12), (short, 10), (cut, 24)):
        folder.mkdir()
        (folder / "camera.yaml").write_text((walk / "camera.yaml").read_text())
        for i in range(frames):
            source = good[i % 2 if folder is cut and i >= 12 else 0]
            picture = cv2.imread(str(source / f"{i if folder is not cut else i % 12:06d}.png"), cv2.IMREAD_GRAYSCALE)
            cv2.imwrite(str(folder / f"{i:06d}.png"), picture * (folder not in (black, dark)))
    (walk / "000004.png").rename(walk / "gone")
    (walk / "000004.png").write_bytes(b"no picture")
    try:
        training, lines = FakeTraining(), list[str]()
        sequences = [black, good[0], tmp_path / "missing", good[1]]
        result = run(tmp_path / "out", sequences, training, rounds=1, progress=ImprovementProgress(lines.append))
    finally:
        (walk / "gone").replace(walk / "000004.png")
    text = "\n".join(lines)
    assert "left out: black: " in text
    assert "left out: missing: " in text
    assert "held back, never trained on: hall" in text
    (store,) = training.calls[0]["labels"]
    (labelled,) = read_labels(store)
    assert labelled.name == "room"
    assert 4 not in labelled.frames.source_index  # unreadable
    assert [found.name for found in read_labels(result.candidates[0].held_back)] == ["hall"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Left out: black: " in page
    # once in the survey, which is the reference too, and once by a link in the labels of the training part
    assert sum("room: " in line and "with a pose" in line for line in lines) == 2
    assert (tmp_path / "out" / "reference" / "hall" / "depth-held-back.zip").is_file()
    assert not (tmp_path / "out" / "reference" / "hall" / "depth-training.zip").exists()
    with pytest.raises(InputError, match="nothing could be labelled"):
        run(tmp_path / "nothing", [black, dark], FakeTraining())
    few = replace(SETTINGS, sequence=replace(SETTINGS.sequence, end=5))
    with pytest.raises(InputError, match="too few"):
        run(tmp_path / "too-short", [short], FakeTraining(), settings=few)


def test_weights_without_activation_ranges_get_them_from_frames_that_are_not_held_back(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from improvo.frontend.weights_files import find_weights, save_weights
    from improvo.improvement import rounds
    from improvo.improvement.folder import ImproveFolder

    bundled = load_weights(find_weights("superpoint-small"))
    mine = tmp_path / "mine.safetensors"
    save_weights(mine, bundled.tensors, replace(bundled.card, activation_ranges={}))
    seen: list[np.ndarray] = []
    calibrate = rounds.write_calibrated
    monkeypatch.setattr(
        rounds,
        "write_calibrated",
        lambda source, target, images: (seen.extend(images), calibrate(source, target, images)),
    )
    folder = ImproveFolder(tmp_path / "out", [walk], [], starting(str(mine)), mine)
    loop = rounds.Rounds(folder, starting(str(mine)), FakeTraining(), (), None, None, ImprovementProgress())
    split = loop.split([walk], [], mine)
    candidate = loop.start(mine, split.training)
    assert load_weights(candidate.weights).card.activation_ranges
    training = [cv2.imread(str(walk / f"{i:06d}.png"), cv2.IMREAD_GRAYSCALE) for i in range(28)]
    assert len(seen) == 2
    assert all(any(np.array_equal(image, frame) for frame in training) for image in seen)


class StoppedError(Exception):
    """Stands for a kill."""


def test_a_run_that_ends_after_each_of_its_steps_goes_on(
    walk: Path,
    finished: tuple[Improvement, FakeTraining, list[str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from improvo.improvement.rounds import Rounds

    made: list[str] = []

    def stop_after(name: str) -> None:
        step = getattr(Rounds, name)

        def stopping(rounds: Rounds, *arguments: object) -> object:
            there = name in ("train", "validate") and arguments[0].validation.is_file()  # type: ignore[attr-defined]
            done = step(rounds, *arguments)
            key = name if name == "reference" else f"{name} {len(training.calls)} {arguments[0]}"
            if key not in made and not there:
                made.append(key)
                raise StoppedError
            return done

        monkeypatch.setattr(Rounds, name, stopping)

    for name in ("reference", "label", "train", "validate"):
        stop_after(name)
    training = FakeTraining()
    stops = 0
    while stops < 20:
        try:
            run(tmp_path / "out", [walk], training)
            break
        except StoppedError:
            stops += 1
    assert stops == len(made) >= 8  # the reference, three validations, two rounds of labelling and learning
    assert len(training.calls) == 2
    assert results(tmp_path / "out") == results(finished[0].weights.parent)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_a_run_that_is_killed_at_random_moments_ends_the_same(
    walk: Path, finished: tuple[Improvement, FakeTraining, list[str]], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(EXAMPLE), str(out), "1", str(walk)]
    chance = random.Random(3)
    killed = 0
    for _ in range(3):
        process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + 60
        while not out.is_dir() and time.monotonic() < deadline:
            time.sleep(0.02)
        time.sleep(chance.uniform(0.2, 5.0))
        killed += process.poll() is None
        process.kill()
        process.wait()
    assert killed
    run(out, [walk], FakeTraining())
    assert results(out) == results(finished[0].weights.parent)
    assert not list(out.rglob("*.partial*"))


@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit on the size of files")
def test_a_full_disk_is_one_line_and_the_run_goes_on_later(
    walk: Path, finished: tuple[Improvement, FakeTraining, list[str]], tmp_path: Path
) -> None:
    import resource

    before, done = resource.getrlimit(resource.RLIMIT_FSIZE), finished[0].weights.parent
    for there in ([], ["start/weights.safetensors", "start/weights.json"]):  # the weights, then the labels do not fit
        out = tmp_path / f"out-{len(there)}"
        for name in (".improvo.json", "settings.yaml", "split.json", *there):
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(done / name, out / name)
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
        try:
            with pytest.raises(ImprovoError, match=r"cannot be written \(.*File too large\)") as caught:
                run(out, [walk], FakeTraining())
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert "\n" not in str(caught.value)
    run(out, [walk], FakeTraining())
    assert results(out) == results(finished[0].weights.parent)


def validation(right: list[float], tracked: int = 100, segments: int = 1, matches: int = 100) -> Validation:
    values = {"right_3px": [value / 2 for value in right], "right_8px": right}
    pairs = [[row, row + 30] for row in range(len(right))]
    scores = GapScores("room", 0, 30, 1.0, pairs, [matches] * len(right), values)
    return Validation(100, tracked, segments, 8.0, 0.8, 0.5, {}, (scores,))


def is_better(candidate: Validation, best: Validation, start: Validation, settings: ValidationSettings) -> bool:
    return not why_not_better(candidate, best, start, settings)


def test_better_is_more_right_matches_with_odometry_that_is_no_worse() -> None:
    settings = ValidationSettings()
    start = validation([0.4, 0.5, 0.6] * 5)
    assert is_better(validation([0.42, 0.51, 0.62] * 5), start, start, settings)
    assert not is_better(validation([0.4, 0.5, 0.6] * 5), start, start, settings)
    assert not is_better(validation([0.6, 0.4, 0.52] * 5), start, start, settings)  # more, by chance
    more = [0.7, 0.8, 0.9] * 5
    assert is_better(validation(more, tracked=99), start, start, settings)
    assert not is_better(validation(more, tracked=98), start, start, settings)
    assert is_better(validation(more, tracked=98), start, start, replace(settings, frames_lost=0.05))
    assert not is_better(validation(more, segments=2), start, start, settings)
    assert is_better(validation(more, segments=2), start, start, replace(settings, segments_more=1))
    assert is_better(
        validation(more, matches=90), start, start, settings
    )  # wrong ones are lost, and some right ones found
    assert not is_better(validation(more, matches=60), start, start, settings)  # right ones are lost too
    nothing = validation([0.4, 0.5, 0.6] * 5, tracked=0, segments=0)
    assert is_better(validation(more), nothing, nothing, settings)  # one segment is no break more than none
    assert not is_better(validation(more, segments=2), nothing, nothing, settings)


def test_what_is_not_better_is_told_why() -> None:
    settings = ValidationSettings()
    start, best = validation([0.4, 0.5, 0.6] * 5), validation([0.5, 0.6, 0.7] * 5)
    assert why_not_better(best, start, start, settings) == ""
    neither = "neither number nor share of right matches is larger than at the start by more than chance"
    for candidate, before, words in (
        (start, start, neither),
        (validation([0.6, 0.4, 0.52] * 5), start, neither),
        (best, best, "number and share of right matches together are no larger than with the best round before"),
        (validation([0.7, 0.8, 0.9] * 5, tracked=90), start, "fewer frames are tracked than at the start (100)"),
        (
            validation([0.7, 0.8, 0.9] * 5, segments=2, matches=50),
            start,
            "fewer of its matches are right than at the start, by more than chance; "
            "the odometry breaks more often than at the start",
        ),
        (
            validation([0.3, 0.4, 0.5] * 5, matches=200),
            start,
            "a smaller share of its matches is right than at the start, by more than chance",
        ),
    ):
        assert why_not_better(candidate, before, start, settings) == words


def test_more_right_matches_are_better_where_their_share_is_the_same_and_the_other_way_round() -> None:
    settings = ValidationSettings()
    start = validation([0.4, 0.5, 0.6] * 5)
    assert is_better(validation([0.4, 0.5, 0.6] * 5, matches=102), start, start, settings)
    assert is_better(validation([0.41, 0.49, 0.6] * 5, matches=102), start, start, settings)  # the share by chance
    assert not is_better(validation([0.39, 0.49, 0.59] * 5, matches=110), start, start, settings)  # a smaller share
    assert is_better(validation([0.408, 0.51, 0.612] * 5, matches=100), start, start, settings)
    assert not is_better(validation([0.41, 0.51, 0.61] * 5, matches=95), start, start, settings)  # fewer right ones


def test_a_later_round_is_better_by_its_sum_if_it_gains_more_than_chance_over_the_start() -> None:
    settings = ValidationSettings()
    start, best = validation([0.4, 0.5, 0.6] * 5), validation([0.42, 0.52, 0.62] * 5)
    hardly = validation([0.52, 0.47, 0.6] * 5)  # than the best by chance, than the start not
    assert gain(hardly, best, "right_8px", settings.matches).low < 0
    assert is_better(hardly, best, start, settings)
    assert not is_better(best, hardly, start, settings)
    assert not is_better(validation([0.6, 0.44, 0.55] * 5), best, start, settings)  # than the start by chance, too
    assert not is_better(validation([0.52, 0.47, 0.6] * 5, matches=60), best, start, settings)
    assert not is_better(validation([0.52, 0.47, 0.6] * 5, tracked=98), best, start, settings)


def test_the_card_has_every_level_where_recordings_share_a_gap() -> None:
    def scores(recording: str, level: int, gap: int, right: float) -> GapScores:
        return GapScores(recording, level, gap, gap / 30, [[0, gap]] * 2, [50, 50], {"right_3px": [right / 2] * 2,
                         "right_8px": [right] * 2})  # fmt: skip

    def measured(better: float) -> Validation:
        slow, fast = (
            [scores("slow", 0, 10, 0.8 + better)],
            [("fast", 0, 5, 0.6 + better), ("fast", 1, 10, 0.3 + better)],
        )
        return Validation(100, 100, 1, 8.0, 0.8, 0.5, {}, (*slow, *(scores(*each) for each in fast)))

    assert summary(measured(0.1), measured(0.0), ValidationSettings()) == {
        "level_0": "5 to 10 frames (0.167 to 0.333 s)", "level_1": "10 frames (0.333 s)",
        "right_3px_level_0": 0.4, "right_3px_level_0_at_the_start": 0.35,
        "right_3px_level_1": 0.2, "right_3px_level_1_at_the_start": 0.15,
        "right_8px_level_0": 0.8, "right_8px_level_0_at_the_start": 0.7,
        "right_8px_level_1": 0.4, "right_8px_level_1_at_the_start": 0.3,
    }  # fmt: skip


def test_the_interval_of_a_gain_is_over_pairs() -> None:
    rng, judge = np.random.default_rng(1), ValidationSettings().matches
    before = rng.uniform(0.2, 0.8, 50)
    found = gain(validation((before + 0.05).tolist()), validation(before.tolist()), "right_8px", judge)
    assert found.low == pytest.approx(0.05)
    assert found.high == pytest.approx(0.05)
    assert found.words.startswith(f"{5 / before.mean():+.1f} %, 95 % interval ")
    after = before + rng.normal(0, 0.2, 50)
    found = gain(validation(after.tolist()), validation(before.tolist()), "right_8px", judge)
    assert found.low < 0 < found.high
    assert found.high - found.low < 0.2
    assert gain(validation([0.1]), validation([0.0]), "right_8px", judge).words.startswith("+0.100")


def test_a_damaged_judgement_is_named(tmp_path: Path) -> None:
    (tmp_path / "judgement.json").write_text("{")
    with pytest.raises(InputError, match="measured again"):
        read_validation(tmp_path / "judgement.json")


def test_a_folder_of_something_else_is_refused(walk: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep me")
    with pytest.raises(OutputError, match="did not write"):
        run(tmp_path, [walk], FakeTraining())


def test_a_growing_set_starts_from_the_last_weights_and_replays_what_it_had(
    walk: Path, finished: tuple[Improvement, FakeTraining, list[str]], tmp_path: Path
) -> None:
    before = finished[0].weights.parent
    hall = write_walk(tmp_path / "hall", frames=40, seed=1)
    default = replace(SETTINGS, frontend=replace(SETTINGS.frontend, name="superpoint-small"))
    training, lines = FakeTraining((0.02,)), list[str]()
    progress = ImprovementProgress(lines.append)
    recordings = [walk, hall]
    result = run(tmp_path / "more", recordings, training, 1, settings=default, after=before, progress=progress)
    (call,) = training.calls
    start, kept = load_weights(call["start"]), load_weights(finished[0].weights)
    assert all(np.array_equal(start.tensors[name], tensor) for name, tensor in kept.tensors.items())
    new, replayed = call["seen"]
    assert max(new) < 28
    assert max(replayed) < 28  # what was held back of the first recording stays so
    (store,) = call["labels"]
    assert [labelled.name for labelled in read_labels(store)] == ["hall"]
    name = f"{before.name}/room"
    assert [validation.earlier for validation in result.validations] == [(name,)] * 2
    assert {scores.recording for scores in result.validations[0].own} == {"hall"}
    earlier = [scores for scores in result.validations[0].scores if scores.earlier]
    assert [scores.pairs for scores in earlier] == [scores.pairs for scores in finished[0].validations[0].scores]
    assert any(line.startswith("round 1: ") and f"; {name}, share: " in line for line in lines)
    for output, sequences, match in (
        (tmp_path / "same", [walk], "add new ones"),
        (before, [walk, hall], "cannot follow itself"),
    ):
        with pytest.raises(ImprovoError, match=match):
            run(output, sequences, FakeTraining(), rounds=1, settings=default, after=before)
    with pytest.raises(InputError, match="no finished folder"):
        run(tmp_path / "other", [hall], FakeTraining(), settings=default, after=tmp_path)
    with pytest.raises(InputError, match="trained on it, so it cannot be held back"):
        run(tmp_path / "other", [hall], FakeTraining(), settings=default, after=before, evaluate=[walk])
    begun = shutil.copytree(before, tmp_path / "begun")
    shutil.rmtree(begun / "round-1")
    with pytest.raises(InputError, match="no finished folder"):
        run(tmp_path / "other", [hall], FakeTraining(), settings=default, after=begun)
    assert not (tmp_path / "other").exists()
    with pytest.raises(ConfigError, match="begun with"):
        run(tmp_path / "more", [hall], FakeTraining(), rounds=1, settings=default)


@pytest.mark.parametrize(("recipe", "seed"), [("held", 7), ("metric", 8), ("tracks", 9)])
def test_a_round_has_the_seed_of_its_recipe(tmp_path: Path, recipe: str, seed: int) -> None:
    settings = config.from_dict(
        ImproveSettings,
        {
            "recipe": recipe,
            "held": {"optimiser": {"seed": 7}},
            "metric": {"seed": 8},
            "training": {"optimiser": {"seed": 9}},
        },
    )
    seeds: list[int] = []

    def train(job: TrainingJob) -> dict[str, Any]:
        seeds.append(job.seed)
        raise InterruptedError

    start = Candidate("start", tmp_path / "start")
    folder: Any = SimpleNamespace(start=start)
    rounds = Rounds(folder, settings, train, (), None, None, ImprovementProgress())
    for number in (1, 2):
        candidate = Candidate(f"round {number}", tmp_path / f"round-{number}")
        with pytest.raises(InterruptedError):
            rounds.train(candidate, number, start, Part((), settings.sequence), ())
    assert seeds == [seed, seed + 1]


def test_what_makes_an_earlier_recording_worse_is_not_better() -> None:
    settings = ValidationSettings()

    def both(new: float, old: float) -> Validation:
        one, other = validation([new] * 15), validation([old + 0.001 * row for row in range(15)])
        return replace(one, scores=(*one.scores, replace(other.scores[0], recording="before/room", earlier=True)))

    start = both(0.5, 0.6)
    assert is_better(both(0.6, 0.6), start, start, settings)
    assert is_better(both(0.6, 0.7), start, start, settings)
    assert not is_better(both(0.6, 0.58), start, start, settings)
    assert not is_better(both(0.5, 0.7), start, start, settings)
    assert both(0.6, 0.2).mean("right_8px") == pytest.approx(0.6)


@pytest.mark.parametrize("earlier", [False, True])
def test_the_card_says_the_rule_that_was_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, earlier: bool) -> None:
    monkeypatch.setattr(loop, "write_report", lambda *rest: None)
    start = Candidate("start", tmp_path / "start")
    start.folder.mkdir()
    weights = load_weights(find_weights("superpoint-small"))
    save_weights(start.weights, weights.tensors, weights.card)
    measured = validation([0.5] * 15)
    if earlier:
        before = replace(measured.scores[0], recording="before/room", earlier=True)
        measured = replace(measured, scores=(*measured.scores, before))
    folder: Any = SimpleNamespace(weights=tmp_path / "weights.safetensors", report=None, finished_rounds=lambda: 0)
    split: Any = None
    loop._keep(Improvement(folder.weights, 0, (start,), (measured,), ("",)), folder, split, ImproveSettings())
    said = load_weights(folder.weights).card.metrics["improvement"]["rule"]
    assert said == rule(ValidationSettings(), earlier)
    assert ("In no recording of an earlier run" in said) == earlier
