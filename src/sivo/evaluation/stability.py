"""How well instability finds its true cause, on simulated recordings: of labels, and of a stability head.

The positives are moving things and highlights (the headline), all causes together, and every cause by itself; the
negatives are always the points that nothing speaks against.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sivo.errors import InputError
from sivo.evaluation.causes import PRECEDENCE, TrueCauses, track_causes
from sivo.types import Float64

HEADLINE = ("moving", "highlight")


@dataclass(frozen=True)
class Judged:
    """Points with a true cause and something that says how unstable they are."""

    cause: NDArray[np.uint8]  # (N,) rank in PRECEDENCE
    scores: dict[str, Float64]  # name -> (N,), larger is less stable
    called_unstable: NDArray[np.bool_]  # (N,)
    total: NDArray[np.int64]  # (len(PRECEDENCE),) points per cause, also those without a label

    @staticmethod
    def joined(parts: Iterable[Judged]) -> Judged:
        """The points of several recordings together."""
        items = list(parts)
        return Judged(
            np.concatenate([item.cause for item in items]),
            {name: np.concatenate([item.scores[name] for item in items]) for name in items[0].scores},
            np.concatenate([item.called_unstable for item in items]),
            np.sum([item.total for item in items], axis=0),
        )


def roc_auc(score: Float64, positive: NDArray[np.bool_]) -> float | None:
    """Chance that a positive has the larger score, ties half (Hanley and McNeil 1982); None without both kinds."""
    from scipy.stats import rankdata

    count = int(positive.sum())
    if not 0 < count < len(positive):
        return None
    ranks = rankdata(score)
    return float((ranks[positive].sum() - count * (count + 1) / 2) / (count * (len(positive) - count)))


def average_precision(score: Float64, positive: NDArray[np.bool_]) -> float | None:
    """Precision averaged over the recall steps; points of equal score count as one step. None without positives."""
    if not positive.any():
        return None
    order = np.argsort(-score, kind="stable")
    hits = np.cumsum(positive[order])
    last = np.flatnonzero(np.diff(score[order], append=np.nan))
    precision = hits[last] / (last + 1)
    recall = hits[last] / positive.sum()
    return float((np.diff(recall, prepend=0.0) * precision).sum())


def judge_labels(labels: Path, simulation: Path) -> Judged:
    """The labelled tracks of one run on one simulated recording.

    Args:
        labels: folder with `points.parquet` and `tracks.parquet`.
        simulation: the recording.

    Raises:
        InputError: a file is missing or does not belong to the other.
    """
    from sivo.labeling.stability import IGNORE, UNSTABLE
    from sivo.labeling.tables import POINTS_FILE, TRACKS_FILE, read_points, read_tracks

    truth = TrueCauses(simulation)
    points, tracks = read_points(labels / POINTS_FILE), read_tracks(labels / TRACKS_FILE)
    source_index, width = _processed(labels, int(tracks.frame.max(initial=-1)) + 1, truth)
    ids, causes = track_causes(
        truth, tracks.frame.astype(np.int64), tracks.track, tracks.keypoints, source_index, width
    )
    row = np.searchsorted(ids, points.track)
    if not np.isin(points.track, ids).all():
        raise InputError(f"{labels}: {POINTS_FILE} has tracks that {TRACKS_FILE} lacks; run it again")
    cause = causes[row]
    labelled = points.stability != IGNORE
    unstable = points.stability[labelled] == UNSTABLE
    scores = {
        "label": unstable.astype(np.float64),
        "mean_error": points.mean_error[labelled].astype(np.float64),
        "max_error": points.max_error[labelled].astype(np.float64),
    }
    return Judged(cause[labelled], scores, unstable, np.bincount(cause, minlength=len(PRECEDENCE)).astype(np.int64))


def judge_frontend(frontend: Any, simulation: Path, stride: int = 10, threshold: float = 0.5) -> Judged:
    """The keypoints of a frontend with a stability head, on every `stride`-th frame of a simulated recording.

    Raises:
        InputError: the frontend has no stability head.
    """
    from sivo.sequences import open_sequence

    truth = TrueCauses(simulation)
    causes, stability = [], []
    for frame in open_sequence(simulation, stride=stride):
        features = frontend(frame.image)
        if features.stability is None:
            raise InputError("this frontend has no stability head; give a weights file that was trained with one")
        causes.append(truth.at(frame.index, features.keypoints, frame.image.shape[1]))
        stability.append(features.stability.astype(np.float64))
    cause, stable = np.concatenate(causes), np.concatenate(stability)
    total = np.bincount(cause, minlength=len(PRECEDENCE)).astype(np.int64)
    return Judged(cause, {"head": 1 - stable}, stable < threshold, total)


def summarise(judged: Judged) -> dict[str, Any]:
    """What `stability.json` says about these points."""
    static = judged.cause == PRECEDENCE.index("static")
    groups = {"moving_or_highlight": HEADLINE, "all": PRECEDENCE[:-1], **{name: (name,) for name in PRECEDENCE[:-1]}}
    rows = []
    for group, names in groups.items():
        ranks = [PRECEDENCE.index(name) for name in names]
        positive = np.isin(judged.cause, ranks)
        used = positive | static
        measures = {
            name: {
                "roc_auc": roc_auc(score[used], positive[used]),
                "average_precision": average_precision(score[used], positive[used]) if static.any() else None,
            }
            for name, score in judged.scores.items()
        }
        rows.append(
            {
                "cause": group,
                "points": int(judged.total[ranks].sum()),
                "labelled": int(positive.sum()),
                "unstable": int((positive & judged.called_unstable).sum()),
                "recall": float(judged.called_unstable[positive].mean()) if positive.any() else None,
                "scores": measures,
            }
        )
    calm = int((static & judged.called_unstable).sum())
    return {
        "causes": rows,
        "static": {
            "points": int(judged.total[PRECEDENCE.index("static")]),
            "labelled": int(static.sum()),
            "unstable": calm,
            "false_alarms": calm / int(static.sum()) if static.any() else None,
        },
    }


def stability_table(results: dict[str, Any]) -> str:
    """The summary as a Markdown table."""
    lines = []
    for subject in results["subjects"]:
        names = list(subject["causes"][0]["scores"])
        head = " | ".join(f"AUC {name}" for name in names)
        lines += [f"{subject['name']}", "", f"| true cause | points | labelled | recall | {head} | AP {names[-1]} |"]
        lines.append("|---|" + "---:|" * (4 + len(names)))
        for row in subject["causes"]:
            aucs = " | ".join(_number(row["scores"][name]["roc_auc"]) for name in names)
            precision = _number(row["scores"][names[-1]]["average_precision"])
            cells = (row["cause"].replace("_", " "), row["points"], row["labelled"], _number(row["recall"]))
            lines.append(f"| {' | '.join(map(str, cells))} | {aucs} | {precision} |")
        calm = subject["static"]
        lines += [
            "",
            f"Static points: {calm['points']}, labelled {calm['labelled']}, called unstable {calm['unstable']}.",
            "",
        ]
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
            "give what `sivo run` or `sivo label` made of this recording"
        )
    return pairs


def _processed(labels: Path, frames: int, truth: TrueCauses) -> tuple[NDArray[np.int64], int]:
    """Which frames of the recording were processed, and how wide they were."""
    width = truth.image(0).shape[1]
    if not (labels / "run.json").is_file():
        return np.arange(frames), width
    try:
        report = json.loads((labels / "run.json").read_text())
        return np.asarray(report["frames"]["source_index"], np.int64), int(report["camera"]["width"])
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{labels / 'run.json'}: is damaged; run the sequence again") from None


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
