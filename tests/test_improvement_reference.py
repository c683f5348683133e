"""The reference run: depth of either part from its own frames, gaps by overlap, and estimates."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rendered_walk import write_walk

from improvement_example import SETTINGS
from improvo.depth.archive import DepthReader
from improvo.errors import ImprovoError, InputError, OutputError
from improvo.evaluation.pose.self_truth import FixedRun
from improvo.frontend.settings import FrontendSettings
from improvo.geometry.camera import Camera
from improvo.improvement.estimate import Costs, Estimate, estimate, refuse_full_disk
from improvo.improvement.gaps import choose_gaps, median_overlap
from improvo.improvement.plan import first_estimate, usual_rounds
from improvo.improvement.recipe import steps_of
from improvo.improvement.reference import (
    HELD_BACK,
    TRAINING,
    ReferencePart,
    frames_with_depth,
    make_depth,
    reference_parts,
    refuse_without_depth,
)
from improvo.improvement.settings import METRIC, TRACKS, ImproveSettings, ReferenceSettings, SplitSettings
from improvo.improvement.split import Split, split_last_part
from improvo.labeling.label_sequences import label_sequences
from improvo.labeling.labeled import LabeledSequence
from improvo.sequences import SequenceSettings

FEW = ReferenceSettings()


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Split]:
    """A label store of a whole recording of 40 frames, and how it is split after frame 27."""
    folder = tmp_path_factory.mktemp("reference")
    walk = write_walk(folder / "room", frames=40, seed=3)
    frontend = FrontendSettings("superpoint-small", max_keypoints=250)
    label_sequences([walk], folder / "store", SETTINGS.run_settings(SequenceSettings(), frontend))
    return folder / "store", split_last_part(walk, SequenceSettings(), SplitSettings(0.3))


def parts_of(labelled: tuple[Path, Split], kind: str) -> ReferencePart:
    store, split = labelled
    (part,) = reference_parts(store, split.training if kind == TRAINING else split.held_back, kind)
    return part


def test_depth_of_a_part_is_made_of_its_own_frames_and_teaches_only_them(
    labelled: tuple[Path, Split], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []
    image = LabeledSequence.image
    monkeypatch.setattr(LabeledSequence, "image", lambda self, frame: (seen.append(frame), image(self, frame))[1])
    training = parts_of(labelled, TRAINING)
    make_depth(training, 100, FEW)
    (posed,) = training.teaching_frames(160)
    assert seen
    assert max(seen) < 28
    assert posed.pictures[0].shape == (120, 160)
    assert len(posed.pictures) == len(posed.inverse_depth) == len(posed.times) >= 20
    assert posed.times.max() <= training.labeled.frames.time[27]
    centre = posed.K @ [0, 0, 1]
    assert centre[:2] == pytest.approx([79.5, 59.5], abs=1)
    seen.clear()
    held_back = parts_of(labelled, HELD_BACK)
    make_depth(held_back, 100, FEW)
    assert seen
    assert min(seen) >= 28
    run = held_back.fixed_run()
    assert np.flatnonzero(run.segment >= 0).min() >= 28
    assert np.flatnonzero(run.has_depth).min() >= 28
    assert (run.depth(int(np.flatnonzero(run.has_depth)[0])) > 0).mean() > 0.3
    seen.clear()
    make_depth(held_back, 100, FEW)  # once
    assert not seen


@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit on the size of files")
def test_a_full_disk_leaves_no_half_of_the_depth(labelled: tuple[Path, Split], tmp_path: Path) -> None:
    import resource

    part = replace(parts_of(labelled, TRAINING), depth_file=tmp_path / "depth.zip")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        with pytest.raises(ImprovoError, match="File too large") as caught:
            make_depth(part, 100, FEW)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_part_without_any_depth_is_one_line(labelled: tuple[Path, Split], tmp_path: Path) -> None:
    nothing = ReferenceSettings(least_known=1.0)
    part = replace(parts_of(labelled, TRAINING), depth_file=tmp_path / "depth.zip")
    make_depth(part, 4, nothing)
    assert DepthReader(part.depth_file).frames == []
    with pytest.raises(InputError, match=r"the training part \(room\): no frame has depth, because the camera moved"):
        refuse_without_depth([part], "the training part", "move")


def test_long_recordings_are_thinned_out_and_then_cut_into_stretches() -> None:
    times = np.arange(9000) / 30.0
    everything = np.arange(9000)
    assert frames_with_depth(times[:200], everything[:200], 900, FEW).tolist() == list(range(200))
    assert np.diff(frames_with_depth(times[:600], everything[:600], 900, FEW)).tolist() == [2] * 299
    assert np.diff(frames_with_depth(times[:2400], everything[:2400], 900, FEW)).tolist() == [3] * 799
    chosen = frames_with_depth(times, everything, 900, FEW)
    assert 700 <= len(chosen) <= 900
    steps = np.diff(chosen)
    assert np.median(steps) == 3
    assert chosen[-1] > 8000  # from all of it
    assert 5 <= (steps > 3).sum() <= 9
    assert frames_with_depth(times, everything[:1], 900, FEW).tolist() == [0]


def sideways(frames: int, step: float) -> FixedRun:
    """A camera that moves sideways before a wall, by a share of what it shows a frame."""
    camera = Camera(64, 48, 32.0, 32.0, 31.5, 23.5)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = step * 2.0 * np.arange(frames)  # at depth 1 it shows two metres
    wall = np.ones((48, 64), np.float32)
    return FixedRun(camera, poses, np.zeros(frames, np.int64), np.ones(frames, np.bool_), lambda frame: wall)


def test_gaps_follow_the_overlap_not_the_frame_rate() -> None:
    assert median_overlap(sideways(40, 0.05), 4) == pytest.approx(0.8, abs=0.07)
    fast, slow = choose_gaps(sideways(60, 0.1), (0.7, 0.5), 10), choose_gaps(sideways(400, 0.01), (0.7, 0.5), 10)
    assert len(fast) == len(slow) == 2
    assert [5 <= many / few <= 13 for few, many in zip(fast, slow, strict=True)] == [True, True]
    assert choose_gaps(sideways(30, 0.001), (0.7, 0.5), 10) == (10, 20)  # hardly any motion: by length
    assert choose_gaps(sideways(5, 0.1), (0.7, 0.5), 10) == ()


def test_steps_follow_the_amount_of_video() -> None:
    settings = ImproveSettings()
    assert [steps_of(settings, frames) for frames in (40, 600, 5000)] == [300, 600, 1200]
    few = replace(settings, held=replace(settings.held, optimiser=replace(settings.held.optimiser, steps=7)))
    assert steps_of(few, 40) == 7
    assert steps_of(replace(settings, steps_per_frame=0), 40) == 1200
    assert steps_of(replace(settings, recipe=TRACKS), 40) == 1000


@pytest.mark.parametrize(
    ("changes", "rounds", "recordings", "frames"),
    [
        # the reference, what is held back of it once more with the settings of the part, and by each candidate
        ({}, 1, 0, 1000 + 200 + 200),
        ({"recipe": METRIC}, 2, 0, 1000 + 200 + 2 * 200),
        ({"recipe": TRACKS}, 1, 0, 1000 + 800 + 200 + 200),  # labels of the part that is trained on too
        ({"recipe": TRACKS}, 2, 0, 1000 + 2 * 800 + 200 + 2 * 200),
        ({"recipe": TRACKS, "control": True}, 1, 0, 1000 + 800 + 200 + 2 * 200),
        # whole recordings have their labels from the reference
        ({}, 1, 1, 1000 + 200),
        ({"recipe": TRACKS}, 1, 1, 1000 + 200),
        ({"recipe": TRACKS}, 2, 1, 1000 + 800 + 2 * 200),
    ],
)
def test_every_labelling_is_in_the_estimate(changes: dict[str, Any], rounds: int, recordings: int, frames: int) -> None:
    settings = replace(ImproveSettings(), **{"control": False, **changes})
    costs = Costs.usual(640 * 480, 300_000)
    assert estimate(settings, rounds, 800, 200, 640 * 480, costs, recordings).labeled_frames == frames


@pytest.mark.parametrize(
    ("first", "each", "rounds"),
    [(3, 2, 2), (20, 8, 2), (20, 11, 1), (29, 9, 2), (29, 16, 1), (60, 29, 2), (60, 31, 1)],  # of minutes
)
def test_rounds_that_are_not_asked_for_take_half_an_hour_or_add_half_to_the_first(
    first: float, each: float, rounds: int
) -> None:
    controls = []

    def said(settings: ImproveSettings, number: int) -> Estimate:
        controls.append(settings.control)
        return Estimate(first + (number - 1) * each, 0, 0, 0, 0, 0)

    assert usual_rounds(replace(ImproveSettings(), control=True), said) == rounds
    assert not any(controls)  # which may be added later


def test_where_nothing_can_be_read_it_is_one_round_and_the_loop_says_so(tmp_path: Path) -> None:
    assert first_estimate([tmp_path / "missing"], ImproveSettings(), None) == (1, None)
    assert first_estimate([tmp_path / "missing"], ImproveSettings(), 3) == (3, None)


def test_a_control_has_as_many_rounds() -> None:
    settings, costs = ImproveSettings(), Costs.usual(640 * 480, 300_000)

    def minutes(rounds: int, control: bool) -> float:
        return estimate(replace(settings, control=control), rounds, 480, 120, 640 * 480, costs).minutes

    added = [minutes(rounds, True) - minutes(rounds, False) for rounds in (1, 2, 3)]
    assert 0 < added[1] - added[0] == pytest.approx(added[2] - added[1])


def test_the_estimate_grows_with_the_work_and_a_full_disk_is_said_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ImproveSettings()
    small = estimate(settings, 1, 480, 120, 640 * 480, Costs.usual(640 * 480, 300_000))
    assert 5 < small.minutes < 30  # with the defaults
    assert estimate(settings, 2, 480, 120, 640 * 480, Costs.usual(640 * 480, 300_000)).minutes > small.minutes
    assert (
        estimate(replace(settings, control=True), 1, 480, 120, 640 * 480, Costs.usual(640 * 480, 300_000)).minutes
        > small.minutes
    )
    assert estimate(settings, 1, 48_000, 12_000, 640 * 480, Costs.usual(640 * 480, 300_000)).disk_mib > small.disk_mib
    assert "minutes on two calm cores" in small.words
    refuse_full_disk(tmp_path / "not" / "there", small)
    usage = type("Usage", (), {"free": 2**20})
    monkeypatch.setattr("improvo.improvement.estimate.shutil.disk_usage", lambda path: usage)
    with pytest.raises(OutputError, match="1 MiB are free where about"):
        refuse_full_disk(tmp_path, small)
