"""The report of the loop: what was measured of every frontend, with pictures of the one at the start and the best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from improvo.errors import InputError
from improvo.files import write_png
from improvo.frontend.weights_files import load_weights
from improvo.improvement.decision import rule
from improvo.improvement.folder import Candidate
from improvo.improvement.settings import ImproveSettings, ValidationSettings
from improvo.improvement.split import Part, Split
from improvo.improvement.validation import Validation, found, gain, gain_words, loose, strict
from improvo.labeling.store import DONE, read_records
from improvo.report.improvement_page import Measure, Round, write_improvement_page
from improvo.sequences import open_sequence
from improvo.training.metrics import METRICS, read_metrics

_LOSSES = ("loss", "detector", "descriptor", "stability")
_PANEL = 400  # pixels, width of each of the three panels of matches
_SINGLE = 800
_FEW_PAIRS = 20  # of a gap


def write_report(
    path: Path,
    candidates: Sequence[Candidate],
    validations: Sequence[Validation],
    faults: Sequence[str],
    best: int,
    split: Split,
    settings: ImproveSettings,
    control: tuple[Candidate, Validation] | None = None,
) -> None:
    """Write `report.html` of all rounds so far.

    Args:
        path: the HTML file.
        candidates, validations: of the start, then of every round.
        faults: why each of them is not kept, in words; empty where it is.
        best: which of them is kept.
        split: what was held back.
        settings: of the loop.
        control: what homographies alone give, if that was asked for.
    """
    start = validations[0]
    rounds = [
        _round(candidate, validation, split, settings, pictures=number in (0, best or len(candidates) - 1))
        for number, (candidate, validation) in enumerate(zip(candidates, validations, strict=True))
    ]
    if control:
        rounds.append(replace(_round(*control, split, settings, pictures=False), aside=True))
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
        _verdict(candidates, validations, faults, best, settings, control),
        _gains([*zip(candidates, validations, strict=True), *([control] if control else [])], settings.validation),
    )


def _measures(start: Validation, settings: ImproveSettings) -> list[Measure]:
    judge = settings.validation.matches
    against = "against the poses and depth of the reference run, mean over the pairs of frames held back"
    measures = [
        Measure(
            _share_name(judge.right_px[1]),
            f"mutual nearest neighbours of {judge.max_keypoints} keypoints that are right within "
            f"{judge.right_px[1]:g} pixels {against}; all gaps together",
        )
    ]
    for limit in reversed(judge.right_px):
        meaning = f"as above, within {limit:g} pixels, of one gap"
        measures += [Measure(_share_name(limit, start.gap_words(level)), meaning) for level in start.levels]
    for name in start.names:
        if not name.startswith("right_"):
            kind, solver = name.split("_", 1)
            within = (
                f"{judge.max_rotation_deg:g} degrees"
                if kind == "rotation"
                else f"{100 * judge.max_translation:g} % of the median depth"
            )
            meaning = f"share of pairs with an error of less than {within} {against}, {judge.shuffles} shuffles"
            measures += [Measure(f"{kind}, {start.gap_words(level)}, {solver}", meaning) for level in start.levels]
    measures += [
        Measure("frames tracked", "share of the frames held back that the odometry gave a pose to", digits=3),
        Measure("segments", "that the trajectory fell into", larger_is_better=False, digits=0),
        Measure("track length", "mean number of frames of a connect-the-dots track", digits=2),
        Measure("stable tracks", "share of the labelled tracks that are stable"),
        Measure("re-projection error, pixels", "median over labelled tracks", larger_is_better=False, digits=3),
    ]
    for name in start.truth:
        measures.append(Measure(f"true: {name}", "pose protocol, by the recording's own depth and true poses"))
    return measures


def _share_name(limit: float, gap: str = "") -> str:
    return f"share of right matches, {limit:g} px, {gap}" if gap else f"share of right matches, {limit:g} px"


def _training_losses(folder: Path) -> dict[str, list[float]]:
    """The rows of `metrics.jsonl`, by column; empty where nothing was trained."""
    rows = read_metrics(folder / METRICS)
    names = [name for name in rows[0] if all(name in row for row in rows)] if rows else []
    return {name: [float(row[name]) for row in rows] for name in names}


def _values(validation: Validation, settings: ValidationSettings) -> dict[str, float]:
    judge = settings.matches
    values = {_share_name(judge.right_px[1]): validation.mean(loose(judge))}
    for name, limit in zip((strict(judge), loose(judge)), judge.right_px, strict=True):
        for level in validation.levels:
            values[_share_name(limit, validation.gap_words(level))] = validation.mean(name, level)
    for name in validation.names:
        if not name.startswith("right_"):
            kind, solver = name.split("_", 1)
            for level in validation.levels:
                values[f"{kind}, {validation.gap_words(level)}, {solver}"] = validation.mean(name, level)
    values["frames tracked"] = validation.tracked / max(validation.frames, 1)
    values["segments"] = validation.segments
    values["track length"] = validation.track_length
    values["stable tracks"] = validation.stable_share
    if validation.error == validation.error:
        values["re-projection error, pixels"] = validation.error
    return {**values, **{f"true: {name}": value for name, value in validation.truth.items()}}


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
        _values(validation, settings.validation),
        labels,
        seconds,
        _pictures(candidate, split, validation, settings) if pictures else (),
        {name: losses[name] for name in ("step", *_LOSSES) if name in losses},
    )


def _gains(judged: Sequence[tuple[Candidate, Validation]], settings: ValidationSettings) -> list[list[str]]:
    """Header, then for each frontend after the first its gain in right matches over the first, with intervals."""
    (_, start), *others = judged
    pairs = [start.pairs(level) for level in start.levels]
    rows = [
        ["right matches", "all gaps", *(start.gap_words(level) for level in start.levels)],
        ["pairs of frames", str(sum(pairs)), *map(str, pairs)],
    ]
    for candidate, validation in others:
        narrow, wide = settings.matches.right_px
        names = {
            loose(settings.matches): f"share, {wide:g} px",
            strict(settings.matches): f"share, {narrow:g} px",
            found(settings.matches): f"number, {wide:g} px",
        }
        for name, what in names.items():
            gains = (gain(validation, start, name, settings.matches, level) for level in (None, *start.levels))
            rows.append([f"{candidate.name}, {what}", *(one.cell for one in gains)])
    return rows


def _verdict(
    candidates: Sequence[Candidate],
    validations: Sequence[Validation],
    faults: Sequence[str],
    best: int,
    settings: ImproveSettings,
    control: tuple[Candidate, Validation] | None,
) -> str:
    start, how = validations[0], settings.validation
    lines = []
    if best:
        gained = gain_words(validations[best], start, how.matches)
        lines.append(f"Kept: {candidates[best].name}; against the start: {gained}.")
    elif len(candidates) > 1:
        lines.append("No round was better than the start: the weights kept are those at the start, unchanged.")
    for candidate, validation, lacking in zip(candidates, validations, faults, strict=True):
        if lacking:
            gained = gain_words(validation, start, how.matches)
            lines.append(f"{candidate.name.capitalize()} is not kept: {lacking}. Against the start: {gained}.")
    if control:
        gained = gain_words(control[1], start, how.matches)
        words = "The control, trained for as many rounds and steps on the same frames by homographies alone"
        lines.append(f"{words}: {gained}.")
    return "\n".join([*lines, rule(how, bool(start.earlier))])


def _notes(
    candidates: Sequence[Candidate], validations: Sequence[Validation], split: Split, settings: ImproveSettings
) -> list[str]:
    start, notes = validations[0], list[str]()
    wanted = len(settings.validation.gaps or settings.validation.overlaps)
    if len(start.levels) < wanted:
        gaps = " and ".join(start.gap_words(level) for level in start.levels)
        notes.append(
            f"What is held back is too short for {wanted} gaps: judged by pairs {gaps} apart. Short gaps are easy; "
            "judge by longer recordings before you believe a small gain."
        )
    for level in start.levels:
        if start.pairs(level) < _FEW_PAIRS:
            notes.append(
                f"Only {start.pairs(level)} pairs of frames held back are {start.gap_words(level)} apart, and all look "
                "at much the same: believe little of what is said of them. Hold back more, with --evaluate or "
                "--set split.share=0.5 in another folder."
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

    frontend = load_frontend(str(candidate.weights), settings.validation.matches.max_keypoints)
    frontend.name = candidate.name
    sequence = open_sequence(part.paths[0], part.sequence)
    gap = min(validation.own[0].gap, len(sequence) - 1)
    a = (len(sequence) - gap) // 2
    first, second = sequence[a], sequence[a + gap]
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
    from improvo.odometry.run.run_folder import RunFolder
    from improvo.report.track_pictures import TrackPictureSettings, paint_labels

    done = [record for record in read_records(candidate.held_back) if record.state == DONE]
    if not done:
        raise InputError(f"{candidate.held_back}: has no labels")
    run = RunFolder(candidate.held_back / done[0].name)
    write_png(target, paint_labels(run, run.frames // 2, TrackPictureSettings(width=_SINGLE)))
