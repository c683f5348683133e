"""The report of the loop: what was measured of every frontend, with pictures of the one at the start and the best."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from improvo.errors import InputError
from improvo.evaluation.pose.unlabelled import spread_pairs
from improvo.files import write_png
from improvo.frontend.weights import load_weights
from improvo.improvement.folder import Candidate
from improvo.improvement.progress import gain_words
from improvo.improvement.settings import ImproveSettings
from improvo.improvement.split import Part, Split
from improvo.improvement.validation import Validation, rule
from improvo.labeling.store import DONE, read_records
from improvo.report.improvement_page import Measure, Round, write_improvement_page
from improvo.sequences import open_sequence
from improvo.training.metrics import METRICS, read_metrics

_LOSSES = ("loss", "detector", "descriptor", "stability")
_PANEL = 400  # pixels, width of each of the three panels of matches
_SINGLE = 800


def write_report(
    path: Path,
    candidates: Sequence[Candidate],
    validations: Sequence[Validation],
    best: int,
    split: Split,
    settings: ImproveSettings,
) -> None:
    """Write `report.html` of all rounds so far.

    Args:
        path: the HTML file.
        candidates, validations: of the start, then of every round.
        best: which of them is kept.
        split: what was held back.
        settings: of the loop.
    """
    start = validations[0]
    rounds = [
        _round(candidate, validation, split, settings, pictures=number in (0, best))
        for number, (candidate, validation) in enumerate(zip(candidates, validations, strict=True))
    ]
    names = ", ".join(one.name for one in split.training.paths[:3])
    if len(split.training.paths) > 3:
        names += f" and {len(split.training.paths) - 3} more"
    write_improvement_page(
        path,
        f"A frontend improved on {names}",
        f"{Path(settings.frontend.name).name}, validated on what it never saw, {split.words}.",
        _measures(start, settings),
        rounds,
        _notes(candidates, validations, split, settings),
        best,
        _verdict(candidates, validations, best, settings),
    )


def _measures(start: Validation, settings: ImproveSettings) -> list[Measure]:
    gaps = start.gaps
    keypoints, pixels = settings.validation.survival.max_keypoints, settings.validation.survival.max_epipolar_error
    measures = [
        Measure(
            _score_name(start),
            f"mutual nearest neighbours of {keypoints} keypoints that agree with one epipolar geometry of the known "
            f"camera within {pixels:g} pixels, mean over the pairs of frames held back",
            digits=1,
        )
    ]
    if len(gaps) > 1:
        measures += [Measure(f"matches that survive {gap} frames", "as above, of one gap", digits=1) for gap in gaps]
    measures += [Measure(f"share of keypoints that survive {gap} frames", "as above, of all") for gap in gaps]
    measures += [
        Measure("frames tracked", "share of the frames held back that the odometry gave a pose to", digits=3),
        Measure("track length", "mean number of frames of a connect-the-dots track", digits=2),
        Measure("stable tracks", "share of the labelled tracks that are stable"),
        Measure("re-projection error, pixels", "median over labelled tracks", larger_is_better=False, digits=3),
    ]
    for name in start.pose:
        limit = "5 degrees" if name.startswith("rotation") else "5 cm"
        measures.append(Measure(name, f"pose protocol, with depth: share of pairs with an error of less than {limit}"))
    return measures


def _score_name(validation: Validation) -> str:
    one = len(validation.gaps) == 1
    return f"matches that survive {validation.gaps[0]} frames" if one else "matches that survive, summed over the gaps"


def _training_losses(folder: Path) -> dict[str, list[float]]:
    """The rows of `metrics.jsonl`, by column; empty where nothing was trained."""
    rows = read_metrics(folder / METRICS)
    names = [name for name in rows[0] if all(name in row for row in rows)] if rows else []
    return {name: [float(row[name]) for row in rows] for name in names}


def _values(validation: Validation) -> dict[str, float]:
    values = {_score_name(validation): validation.score}
    for gap in validation.gaps:
        values[f"matches that survive {gap} frames"] = validation.surviving(gap)
        values[f"share of keypoints that survive {gap} frames"] = validation.share[str(gap)]
    values["frames tracked"] = validation.tracked / max(validation.frames, 1)
    values["track length"] = validation.track_length
    values["stable tracks"] = validation.stable_share
    if validation.error == validation.error:
        values["re-projection error, pixels"] = validation.error
    return {**values, **validation.pose}


def _round(
    candidate: Candidate, validation: Validation, split: Split, settings: ImproveSettings, pictures: bool
) -> Round:
    losses = _training_losses(candidate.training)
    seconds = {"label what is held back": validation.seconds["label"], "evaluate": validation.seconds["evaluate"]}
    labels: dict[str, int] = {}
    if candidate.labels.is_dir():
        records = [record for record in read_records(candidate.labels) if record.state == DONE]
        labels = {name: sum(getattr(one, name) for one in records) for name in ("stable", "unstable", "ignore")}
        seconds = {"label what is trained on": sum(record.seconds for record in records), **seconds}
    trained = load_weights(candidate.weights).card.training if losses else {}
    if "seconds" in trained:
        seconds = {"train": float(trained["seconds"]), **seconds}
    return Round(
        candidate.name,
        _values(validation),
        labels,
        seconds,
        _pictures(candidate, split, validation, settings) if pictures else (),
        {name: losses[name] for name in ("step", *_LOSSES) if name in losses},
    )


def _verdict(
    candidates: Sequence[Candidate], validations: Sequence[Validation], best: int, settings: ImproveSettings
) -> str:
    words = rule(settings.validation)
    if best:
        gain = gain_words(validations[best], validations[0])
        return f"{words} Kept: {candidates[best].name}; matches that survive against the start: {gain}."
    if len(candidates) > 1:
        return f"{words} No round was better than the start: the weights kept are those at the start, unchanged."
    return words


def _notes(
    candidates: Sequence[Candidate], validations: Sequence[Validation], split: Split, settings: ImproveSettings
) -> list[str]:
    start, notes = validations[0], list[str]()
    if start.gaps != settings.validation.survival.gaps:
        missing = " and ".join(str(gap) for gap in settings.validation.survival.gaps if gap not in start.gaps)
        used = " and ".join(map(str, start.gaps))
        notes.append(
            f"What is held back is too short for pairs {missing} frames apart: judged by pairs {used} frames apart. "
            "Short gaps are easy; judge by longer recordings before you believe a small gain."
        )
    notes += [f"Left out: {reason}" for reason in split.unusable]
    for candidate, validation in zip(candidates, validations, strict=True):
        notes += [f"{candidate.name}, no labels of {failure}" for failure in validation.failures]
        if candidate.labels.is_dir():
            failed = [record for record in read_records(candidate.labels) if record.state != DONE]
            notes += [f"{candidate.name}, not trained on {record.name}: {record.reason}" for record in failed]
    return notes


def _pictures(
    candidate: Candidate, split: Split, validation: Validation, settings: ImproveSettings
) -> tuple[tuple[Path, str], ...]:
    """Matches of a pair held back, the labels that it makes there, and its stability; drawn once."""
    pictures = []
    for name, caption, draw in (
        ("matches.png", "matches of two frames held back", _draw_matches),
        ("labels.png", "labels of a frame held back", _draw_labels),
        ("stability.png", "stability of a frame held back", _draw_stability),
    ):
        target = candidate.folder / "pictures" / name
        if not target.is_file():
            target.parent.mkdir(exist_ok=True)
            try:
                draw(target, candidate, split.held_back, validation, settings)
            except InputError:  # a frame that cannot be read, no stability head, no labels: no picture
                continue
        pictures.append((target, caption))
    return tuple(pictures)


def _draw_matches(
    target: Path, candidate: Candidate, part: Part, validation: Validation, settings: ImproveSettings
) -> None:
    from improvo.frontend.registry import load_frontend
    from improvo.report.match_picture import paint_matches

    frontend = load_frontend(str(candidate.weights), settings.validation.survival.max_keypoints)
    frontend.name = candidate.name
    sequence = open_sequence(part.paths[0], part.sequence)
    pairs = spread_pairs(len(sequence), validation.gaps[0], settings.validation.survival.pairs)
    if len(pairs) == 0:
        raise InputError(f"{part.paths[0]}: too short for a pair")
    a, b = (int(row) for row in pairs[len(pairs) // 2])
    first, second = sequence[a], sequence[b]
    masks = first.mask, second.mask
    picture = paint_matches(frontend, first.image, second.image, None, sequence.camera, width=_PANEL, masks=masks)
    write_png(target, picture)


def _draw_stability(
    target: Path, candidate: Candidate, part: Part, validation: Validation, settings: ImproveSettings
) -> None:
    from improvo.frontend.network import load_network_frontend
    from improvo.report.stability_picture import paint_stability

    frontend = load_network_frontend(candidate.weights, max_keypoints=settings.frontend.max_keypoints)
    sequence = open_sequence(part.paths[0], part.sequence)
    frame = sequence[len(sequence) // 2]
    write_png(target, paint_stability(frame.image, frontend, candidate.name, width=_SINGLE, mask=frame.mask))


def _draw_labels(
    target: Path, candidate: Candidate, part: Part, validation: Validation, settings: ImproveSettings
) -> None:
    from improvo.odometry.run_folder import RunFolder
    from improvo.report.track_pictures import TrackPictureSettings, paint_labels

    done = [record for record in read_records(candidate.held_back) if record.state == DONE]
    if not done:
        raise InputError(f"{candidate.held_back}: has no labels")
    run = RunFolder(candidate.held_back / done[0].name)
    write_png(target, paint_labels(run, run.frames // 2, TrackPictureSettings(width=_SINGLE)))
