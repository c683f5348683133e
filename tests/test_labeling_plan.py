"""What labelling and improving will cost, measured on a sample."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from rendered_walk import write_walk

from improvement_example import SETTINGS as EXAMPLE
from improvo.cli.main import main
from improvo.cli.plan import duration, size, useful_workers
from improvo.errors import InputError
from improvo.frontend.weights_files import find_weights
from improvo.improvement.estimate import Costs
from improvo.improvement.plan import plan_improvement
from improvo.improvement.plan_sample import measure
from improvo.improvement.settings import ImproveSettings
from improvo.labeling import plan as module
from improvo.labeling.label_sequences import fingerprint
from improvo.labeling.plan import LabelPlan, plan_labels
from improvo.labeling.store import DONE, LabelStore, SequenceRecord, finish_sequence
from improvo.odometry.run_settings import LabelRunSettings, RunSettings
from improvo.sequences.base import SequenceSettings

ORB = ["--frontend", "orb", "--max-keypoints", "200", "--set", "labels.min_observations=6"]
ORB += ["--set", "labels.quality.enabled=false"]


def plan_of(**changed: float) -> LabelPlan:
    values = {
        "recordings": 40, "frames": 8000, "longest_frames": 200, "sample_frames": 300, "frame_seconds": 0.1,
        "recording_seconds": 2.0, "memory_mib": 400, "frame_bytes": 2048.0,
    }  # fmt: skip
    return LabelPlan(**{**values, **changed})


def test_time_is_shared_by_workers_up_to_one_for_each_recording() -> None:
    plan = plan_of()
    assert plan.core_seconds == pytest.approx(880)
    assert plan.seconds(1) == pytest.approx(880)
    assert plan.seconds(4) == pytest.approx(220)
    assert plan.seconds(40) == plan.seconds(1000) == pytest.approx(22)
    assert plan_of(longest_frames=4000).seconds(40) == pytest.approx(402)  # one worker has the longest recording
    assert plan.storage_mib == pytest.approx(15.625)
    assert useful_workers(plan) == [1, 2, 4, 8, 16, 32, 64]
    assert useful_workers(plan_of(recordings=1)) == [1]


def test_a_plan_measures_a_sample_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    walks = [str(write_walk(tmp_path / name, frames=24, seed=seed)) for seed, name in enumerate(("attic", "hall"))]
    (tmp_path / "empty").mkdir()
    before = sorted(tmp_path.rglob("*"))
    assert main(["label", "--plan", *walks, str(tmp_path / "empty"), *ORB, "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert sorted(tmp_path.rglob("*")) == before
    assert values["recordings"] == 3
    assert values["frames"] == 72  # of the empty one nothing is known: as many as the others have
    assert values["longest_frames"] == 24
    assert values["sample_frames"] == 48
    assert 0.001 < values["frame_seconds"] < 5
    assert values["memory_mib"] > 50
    assert values["frame_bytes"] > 100
    hours = (values["frames"] * values["frame_seconds"] + 3 * values["recording_seconds"]) / 3600
    assert values["core_hours"] == pytest.approx(hours, abs=1e-4)
    assert values["seconds_by_workers"]["2"] == pytest.approx(values["seconds_by_workers"]["1"] / 2, abs=0.1)


def test_samples_are_short_and_of_a_few_recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[tuple[str, int | None, bool]] = []

    def here(work: object, jobs: list, on_result: object, on_ticks: object, workers: int) -> None:
        for job in jobs:
            done.append((job.path.name, job.settings.sequence.max_frames, job.pack))
            on_result(job, InputError("dark"))

    monkeypatch.setattr(module, "run_in_processes", here)
    monkeypatch.setattr(module, "_lengths", lambda paths, settings: dict.fromkeys(paths, 1000))
    with pytest.raises(InputError, match="no sample could be labelled; the first: dark"):
        plan_labels([tmp_path / f"{n}" for n in range(9)], LabelRunSettings(), pack=True)
    assert done == [("0", 150, True), ("4", 150, True), ("8", 150, True)]


def test_samples_are_kept_in_a_store_without_labels_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is done already would cost nothing, and a plan would say so."""
    settings = LabelRunSettings()
    short = replace(settings, sequence=replace(settings.sequence, max_frames=module.SAMPLE_FRAMES))
    store = LabelStore(tmp_path / "labels", fingerprint(short, pack=False), kind=type(short))
    store.partial("sample-0").mkdir()
    finish_sequence(store.folder, SequenceRecord("sample-0", str(tmp_path), DONE))
    monkeypatch.setattr(module, "_lengths", lambda paths, settings: dict.fromkeys(paths, 60))
    with pytest.raises(InputError, match=r"labels: has labels already; give a new folder"):
        plan_labels([tmp_path], settings, folder=tmp_path / "labels")
    assert (tmp_path / "labels" / "sample-0").is_dir()


def test_more_recordings_are_sampled_where_they_are_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def here(work: object, jobs: list, on_result: object, on_ticks: object, workers: int) -> None:
        done.extend(job.path.name for job in jobs)
        for job in jobs:
            on_result(job, InputError("dark"))

    monkeypatch.setattr(module, "run_in_processes", here)
    monkeypatch.setattr(module, "_lengths", lambda paths, settings: dict.fromkeys(paths, 60))
    with pytest.raises(InputError, match="no sample"):
        plan_labels([tmp_path / f"{n}" for n in range(40)], LabelRunSettings())
    assert done == ["0", "6", "13", "20", "26", "32", "39"]


@pytest.mark.parametrize(("whole", "recording", "frame"), [(True, 10.0, 2.0), (False, 40.0, 1.0)])
def test_the_start_of_a_map_is_a_cost_of_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: bool, recording: float, frame: float
) -> None:
    """Opening takes 10 s, each of the first 30 frames 2 s, the others 1 s; of a whole sample all take 2 s."""
    clock = iter([0.0, *(12.0 + 2 * n for n in range(30)), *(71.0 + (2 if whole else 1) * n for n in range(30)), 999.0])
    end = 130.0 if whole else 100.0
    seen: list[float] = []

    def process_time() -> float:
        seen.append(next(clock) if len(seen) < 61 else end)
        return seen[-1]

    def label(job: module.LabelJob, tick: object) -> SequenceRecord:
        for _ in range(60):
            tick()  # type: ignore[operator]
        return SequenceRecord("a", "", DONE, frames=60)

    monkeypatch.setattr(module.time, "process_time", process_time)
    monkeypatch.setattr(module, "label_sequence", label)
    settings = LabelRunSettings(sequence=SequenceSettings(max_frames=100 if whole else 60))
    sample = module._sampled(module.LabelJob("a", tmp_path, tmp_path, settings, False), lambda: None)
    assert sample.frame == pytest.approx(frame, rel=0.03)
    assert sample.recording == pytest.approx(recording, abs=2.1)


def test_why_no_recording_can_be_opened_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    assert main(["label", "--plan", str(tmp_path / "empty")]) == 2
    assert "the folder is empty" in capsys.readouterr().err
    playlist = tmp_path / "list.mp4"
    playlist.write_text("ffconcat version 1.0\nfile other.mp4\n")
    assert main(["label", "--plan", str(playlist), str(tmp_path / "empty")]) == 2
    assert "list.mp4: is a text, not a video" in capsys.readouterr().err


def test_without_a_plan_the_output_must_be_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    for command in ("label", "improve"):
        assert main([command, str(tmp_path / "empty")]) == 2
        assert "-o" in capsys.readouterr().err


def test_the_loop_runs_what_is_held_back_more_than_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    measured: list[str] = []

    def plan(paths: list[Path], settings: RunSettings, **_: object) -> LabelPlan:
        measured.append(Path(settings.frontend.name).name)
        return plan_of(frames=1000, recordings=len(paths))

    def costs(store: Path, weights: Path, settings: object, usual: Costs) -> Costs:
        return replace(usual, depth=1.0, step=2.0, pair=0.5, start=10.0)

    monkeypatch.setattr("improvo.improvement.plan.measure", costs)
    monkeypatch.setattr("improvo.improvement.plan.plan_labels", plan)
    walk = str(write_walk(tmp_path / "attic", frames=4, seed=0))
    assert main(["improve", "--plan", walk, "--rounds", "2", "--frontend", "superpoint-small", "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert measured == ["superpoint-small.safetensors"]
    # all once for the reference, and the fifth held back with the start and in each of two rounds
    assert values["labelings"] == pytest.approx(1.6)
    assert values["labelling"]["core_hours"] == pytest.approx(1.6 * (1000 * 0.1 + 2.0) / 3600, abs=1e-3)
    metric = 800 * 0.1 + 1500 * 0.02  # features of the frames, and its pairs
    depth, training, pairs = 800 + 200, 2 * (10 + 2 * 800 + metric), 3 * 3 * 100 * 0.5
    assert values["others"]["other_minutes"] == pytest.approx((depth + training + pairs) / 60)
    assert values["others"]["measured"]
    assert [path.name for path in tmp_path.iterdir()] == ["attic"]


def test_whole_recordings_are_not_labelled_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("improvo.improvement.plan.plan_labels", lambda paths, settings, **_: plan_of(frames=1000))
    monkeypatch.setattr("improvo.improvement.plan.measure", lambda *_: None)
    walks = [write_walk(tmp_path / f"{n}", frames=4, seed=0) for n in range(2)]
    plan = plan_improvement(walks, ImproveSettings(), 1)
    assert plan.labelings == pytest.approx(1.2)
    assert not plan.measured


def test_a_plan_after_a_folder_that_is_not_there_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    walk = str(write_walk(tmp_path / "attic", frames=4, seed=0))
    for after in (tmp_path / "missing", tmp_path):
        assert main(["improve", "--plan", walk, "--after", str(after)]) == 2
        error = capsys.readouterr().err.strip().splitlines()[-1]
        assert error.startswith(f"improvo: {after}: is no finished folder of `improvo improve`")


def test_a_plan_after_a_folder_is_of_the_new_recordings_with_its_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old, new = (write_walk(tmp_path / name, frames=4, seed=0) for name in ("old", "new"))
    before = tmp_path / "before"
    (before / "round-1").mkdir(parents=True)
    (before / "round-1" / "judgement.json").write_text("{}")
    shutil.copy(find_weights("superpoint-small"), before / "weights.safetensors")
    (before / "settings.yaml").write_text("rounds: 1\n")
    part = {"paths": [str(old)], "sequence": {}}
    (before / "split.json").write_text(json.dumps({"training": part, "held_back": part, "words": "old"}))
    planned: list[tuple[list[Path], str]] = []

    def plan(paths: list[Path], settings: RunSettings, **_: object) -> LabelPlan:
        planned.append((paths, settings.frontend.name))
        return plan_of(frames=1000)

    monkeypatch.setattr("improvo.improvement.plan.plan_labels", plan)
    monkeypatch.setattr("improvo.improvement.plan.measure", lambda *_: None)
    plan_improvement([old, new], ImproveSettings(), 1, after=before)
    assert planned == [([new], str(before / "weights.safetensors"))]
    with pytest.raises(InputError, match="add new ones"):
        plan_improvement([old], ImproveSettings(), 1, after=before)


def test_the_parts_of_the_loop_are_measured(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="training needs the extra `train`")
    walk = write_walk(tmp_path / "attic", frames=12, seed=3)
    settings = replace(EXAMPLE, frontend=replace(EXAMPLE.frontend, name="superpoint-small"))
    settings = replace(settings, held=replace(settings.held, longer_side=96))
    run_settings = settings.run_settings(settings.sequence, settings.frontend)
    plan_labels([walk], run_settings, folder=tmp_path / "plan" / "labels")
    usual = Costs(frame=1.0, depth=-1.0, step=-1.0, pair=-1.0, start=-1.0)
    found = measure(tmp_path / "plan" / "labels", find_weights("superpoint-small"), settings, usual)
    assert found is not None
    assert found.frame == 1.0
    assert 0.001 < found.depth < 10
    assert 0.001 < found.step < 30
    assert 0 <= found.start < 100
    assert 0.001 < found.pair < 10


def test_sizes_and_durations_read_well() -> None:
    assert [duration(s) for s in (3.2, 130, 7300)] == ["3 s", "2 min", "2.0 h"]
    assert [size(m) for m in (12.3, 2048, 3e6)] == ["12 MiB", "2.0 GiB", "2.9 TiB"]
