"""How well instability finds its true cause, on simulated recordings: of labels, and of a stability head.

The positives are moving things and highlights (the headline), all causes together, and every cause by itself; the
negatives are the points on static surfaces that nothing speaks against. Of tracks it is also known, from true poses and
depth, which of those left their surface point: wrong links make a track unstable whatever it lies on. They are a row of
their own, and every measure is given against all static points and against those that were followed. In the same way
the tracks on movers are told apart: a drawer that nobody pulls is as good as static, and only some `left_its_place`.

The label is made from the mean and the largest error of a track. Two graded scores are those; the third is the median
error, which one wrong link in a good track does not move, but a thing that moves does: it tells the place from the
accident.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from improvo.errors import InputError
from improvo.evaluation.stability.causes import PRECEDENCE, TrueCauses, track_causes
from improvo.evaluation.stability.true_errors import true_track_errors
from improvo.evaluation.statistics import average_precision
from improvo.types import Float32, Float64, Int64
from improvo.untrusted.text import read_json_file

HEADLINE = ("moving", "highlight")
LEFT_PLACE_PX = 5.0  # distance from where a static point would be: wrongly linked, or the thing moved


@dataclass(frozen=True)
class ScoredPoints:
    """Points with a true cause and something that says how unstable they are."""

    cause: NDArray[np.uint8]  # (N,) rank in PRECEDENCE
    scores: dict[str, Float64]  # name -> (N,), larger is less stable
    called_unstable: NDArray[np.bool_]  # (N,)
    total: NDArray[np.int64]  # (len(PRECEDENCE),) points per cause, also those without a label
    true_error: Float64  # (N,) pixels, see `true_track_errors`; NaN where unknown

    @staticmethod
    def joined(parts: Iterable[ScoredPoints]) -> ScoredPoints:
        """The points of several recordings together."""
        items = list(parts)
        return ScoredPoints(
            np.concatenate([item.cause for item in items]),
            {name: np.concatenate([item.scores[name] for item in items]) for name in items[0].scores},
            np.concatenate([item.called_unstable for item in items]),
            np.sum([item.total for item in items], axis=0),
            np.concatenate([item.true_error for item in items]),
        )


def roc_auc(score: Float64, positive: NDArray[np.bool_]) -> float | None:
    """Chance that a positive has the larger score, ties half (Hanley and McNeil 1982); None without both kinds."""
    count = int(positive.sum())
    if not 0 < count < len(positive):
        return None
    _, places, times = np.unique(score, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(times) - 0.5 * (times - 1))[places]  # from 1, equal scores share theirs
    return float((ranks[positive].sum() - count * (count + 1) / 2) / (count * (len(positive) - count)))


def score_labels(labels: Path, simulation: Path) -> ScoredPoints:
    """The labelled tracks of one run on one simulated recording.

    Args:
        labels: folder with `points.parquet` and `tracks.parquet`.
        simulation: the recording.

    Raises:
        InputError: a file is missing or does not belong to the other.
    """
    from improvo.sequences import open_sequence
    from improvo.stability.rule import IGNORE, UNSTABLE
    from improvo.stability.tables import POINTS_FILE, TRACKS_FILE, read_points, read_tracks

    truth = TrueCauses(simulation)
    points, tracks = read_points(labels / POINTS_FILE), read_tracks(labels / TRACKS_FILE)
    frames = tracks.frame.astype(np.int64)
    source_index, width = _processed(labels, int(frames.max(initial=-1)) + 1, truth)
    ids, causes = track_causes(truth, frames, tracks.track, tracks.keypoints, source_index, width)
    row = np.searchsorted(ids, points.track)
    if not np.isin(points.track, ids).all():
        raise InputError(f"{labels}: {POINTS_FILE} has tracks that {TRACKS_FILE} lacks; run it again")
    cause = causes[row]
    labelled = points.stability != IGNORE
    unstable = points.stability[labelled] == UNSTABLE
    scores = {
        "label": unstable.astype(np.float64),
        "median_error": median_errors(tracks.track, tracks.error, points.track[labelled]),
        "mean_error": points.mean_error[labelled].astype(np.float64),
        "max_error": points.max_error[labelled].astype(np.float64),
    }
    sequence = open_sequence(simulation, width=width)
    depth = {row: sequence.depth(int(index)) for row, index in enumerate(source_index)}
    true_error = np.full(int(labelled.sum()), np.nan)
    if sequence.ground_truth is not None:
        true_error = true_track_errors(
            frames,
            tracks.track,
            tracks.keypoints,
            points.track[labelled],
            sequence.camera,
            sequence.ground_truth.world_from_cam[source_index],
            {row: image for row, image in depth.items() if image is not None},
        )
    total = np.bincount(cause, minlength=len(PRECEDENCE)).astype(np.int64)
    return ScoredPoints(cause[labelled], scores, unstable, total, true_error)


def median_errors(track: Int64, error: Float32, wanted: Int64) -> Float64:
    """Median error (T,) of each wanted track.

    Args:
        track: (M,) of each observation.
        error: (M,) pixels; NaN does not count.
        wanted: (T,) tracks.

    Raises:
        InputError: a track without any error.
    """
    from improvo.stability.grouping import medians, rows_of

    of_wanted = np.isin(track, wanted)
    result = medians(rows_of(wanted, track[of_wanted]), error[of_wanted], len(wanted))
    if np.isnan(result).any():
        raise InputError("a labelled track has no error in tracks.parquet; run the sequence again")
    return result


def score_head(frontend: Any, simulation: Path, stride: int = 10, threshold: float = 0.5) -> ScoredPoints:
    """The keypoints of a frontend with a stability head, on every `stride`-th frame of a simulated recording.

    Args:
        frontend: with a stability head.
        simulation: the recording.
        stride: frames between those that are shown to it.
        threshold: probability of being stable below which a keypoint is called unstable.

    Raises:
        InputError: the frontend has no stability head.
    """
    from improvo.sequences import open_sequence

    truth = TrueCauses(simulation)
    causes, stability = [], []
    for frame in open_sequence(simulation, stride=stride):
        features = frontend(frame.image)
        if features.stability is None:
            raise InputError("this frontend has no stability head; give a weights file that was trained with one")
        causes.append(truth.at(frame.source_index, features.keypoints, frame.image.shape[1]))
        stability.append(features.stability.astype(np.float64))
    cause, stable = np.concatenate(causes), np.concatenate(stability)
    total = np.bincount(cause, minlength=len(PRECEDENCE)).astype(np.int64)
    return ScoredPoints(cause, {"head": 1 - stable}, stable < threshold, total, np.full(len(cause), np.nan))


def summarise(scored: ScoredPoints) -> dict[str, Any]:
    """What `stability.json` says about these points."""
    static = scored.cause == PRECEDENCE.index("static")
    left_place = static & (scored.true_error >= LEFT_PLACE_PX)
    followed = static & (scored.true_error < LEFT_PLACE_PX)
    groups = {"moving_or_highlight": HEADLINE, "all": PRECEDENCE[:-1], **{name: (name,) for name in PRECEDENCE[:-1]}}
    rows = []
    for group, names in groups.items():
        ranks = [PRECEDENCE.index(name) for name in names]
        positive = np.isin(scored.cause, ranks)
        rows.append(_row(group, int(scored.total[ranks].sum()), positive, static, followed, scored))
    if np.isfinite(scored.true_error).any():
        away = (scored.cause == PRECEDENCE.index("moving")) & (scored.true_error >= LEFT_PLACE_PX)
        rows.append(_row("moving_left_its_place", int(away.sum()), away, static, followed, scored))
        rows.append(_row("wrong_links", int(left_place.sum()), left_place, followed, followed, scored))
    return {
        "causes": rows,
        "static": {
            "points": int(scored.total[PRECEDENCE.index("static")]),
            "labelled": int(static.sum()),
            **_share("false_alarms", static, scored),
            "followed": {"labelled": int(followed.sum()), **_share("false_alarms", followed, scored)},
        },
    }


def _row(
    name: str,
    points: int,
    positive: NDArray[np.bool_],
    static: NDArray[np.bool_],
    followed: NDArray[np.bool_],
    scored: ScoredPoints,
) -> dict[str, Any]:
    """Counts, recall and measures of one group of positives."""
    measures = {}
    for score_name, score in scored.scores.items():
        measures[score_name] = {
            "roc_auc": roc_auc(score[positive | static], positive[positive | static]),
            "roc_auc_followed": roc_auc(score[positive | followed], positive[positive | followed]),
            "average_precision": average_precision(score[positive | static], positive[positive | static]),
        }
    counts = {"cause": name, "points": points, "labelled": int(positive.sum())}
    return {**counts, **_share("recall", positive, scored), "scores": measures}


def _share(name: str, chosen: NDArray[np.bool_], scored: ScoredPoints) -> dict[str, Any]:
    unstable = scored.called_unstable[chosen]
    return {"unstable": int(unstable.sum()), name: float(unstable.mean()) if len(unstable) else None}


def stability_table(results: dict[str, Any]) -> str:
    """The summary as Markdown: AUC against all static points / against those that were truly followed."""
    lines = []
    for subject in results["subjects"]:
        names = list(subject["causes"][0]["scores"])
        known = subject["static"]["followed"]["labelled"] > 0
        head = " | ".join(f"AUC {name}" for name in names)
        lines += [f"{subject['name']}", "", f"| true cause | points | labelled | recall | {head} | AP {names[-1]} |"]
        lines.append("|---|" + "---:|" * (4 + len(names)))
        for row in subject["causes"]:
            cells = [row["cause"].replace("_", " "), str(row["points"]), str(row["labelled"]), _number(row["recall"])]
            for name in names:
                score = row["scores"][name]
                followed = f" / {_number(score['roc_auc_followed'])}" if known else ""
                cells.append(_number(score["roc_auc"]) + followed)
            cells.append(_number(row["scores"][names[-1]]["average_precision"]))
            lines.append(f"| {' | '.join(cells)} |")
        calm = subject["static"]
        text = f"Static points: {calm['points']}, labelled {calm['labelled']}, called unstable {calm['unstable']}"
        if known:
            text += f"; truly followed {calm['followed']['labelled']}, called unstable {calm['followed']['unstable']}"
        lines += ["", f"{text}.", ""]
    return "\n".join(lines)


def paired_folders(labels: Path, simulation: Path) -> list[tuple[Path, Path]]:
    """Runs and the recordings they belong to: the two folders themselves, or their sub-folders of equal names.

    Raises:
        InputError: there is no pair.
    """
    if (labels / "points.parquet").is_file():
        return [(labels, simulation)]
    children = (
        sorted(child for child in labels.iterdir() if (child / "points.parquet").is_file()) if labels.is_dir() else []
    )
    if len(children) == 1 and (simulation / "simulation.json").is_file():
        return [(children[0], simulation)]
    pairs = [(child, simulation / child.name) for child in children if (simulation / child.name).is_dir()]
    if not pairs:
        raise InputError(
            f"{labels}: has no points.parquet that belongs to {simulation}; "
            "give what `improvo run` or `improvo label` made of this recording"
        )
    return pairs


def _processed(labels: Path, frames: int, truth: TrueCauses) -> tuple[NDArray[np.int64], int]:
    """Which frames of the recording were processed, and how wide they were."""
    width = truth.image(0).shape[1]
    if not (labels / "run.json").is_file():
        return np.arange(frames), width
    try:
        report = read_json_file(labels / "run.json", "run the sequence again")
        return np.asarray(report["frames"]["source_index"], np.int64), int(report["camera"]["width"])
    except (OSError, ValueError, LookupError, TypeError, OverflowError):
        raise InputError(f"{labels / 'run.json'}: is damaged; run the sequence again") from None


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
