"""From records of single pairs to the rows of Table 1, as plain data that `pose.json` holds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from improvo.config import to_dict
from improvo.evaluation.measures import relative_motion
from improvo.evaluation.pose.pairs import overlapping
from improvo.evaluation.pose.protocol import Records
from improvo.evaluation.pose.run import PoseRun
from improvo.evaluation.settings import PoseSettings
from improvo.evaluation.statistics import Bootstrap, accuracy_curve, area_shares, below
from improvo.geometry.se3 import rotation_angle_deg
from improvo.types import Float64

NAMED_FRAMES = 10  # invalid or unreadable frames that are named, not only counted
CURVE_POINTS = 101


def results(run: PoseRun) -> dict[str, Any]:
    """Everything that `pose.json` holds.

    `rows` has one entry per frontend, estimator and gap over all sequences, `sequence_rows` the same for each
    sequence, `differences` how each frontend but the first differs from the first on the same pairs, `curves` the
    accuracy over thresholds, `gaps` the average relative pose, `sequences` what was used.
    """
    settings = run.settings
    rows, sequence_rows, curves, differences = [], [], [], []
    for gap in settings.gaps:
        in_gap = run.records[run.records["gap"] == gap]
        bootstraps: dict[int | None, Bootstrap] = {None: _bootstrap(in_gap, settings)}
        for sequence in np.unique(in_gap["sequence"]):
            bootstraps[int(sequence)] = _bootstrap(in_gap[in_gap["sequence"] == sequence], settings)
        for frontend, label in enumerate(run.frontends):
            for estimator, solver in enumerate(settings.estimators):
                chosen = in_gap[(in_gap["frontend"] == frontend) & (in_gap["estimator"] == estimator)]
                head = {"frontend": label, "estimator": solver, "gap": gap}
                rows.append({**head, **_row(chosen, settings, bootstraps[None])})
                if frontend:
                    first = in_gap[(in_gap["frontend"] == 0) & (in_gap["estimator"] == estimator)]
                    differences.append({**head, **_difference(first, chosen, settings, bootstraps[None])})
                curves.append({**head, **_curves(chosen, settings)})
                for sequence in np.unique(chosen["sequence"]):
                    part = chosen[chosen["sequence"] == sequence]
                    name = run.sequences[sequence].name
                    row = _row(part, settings, bootstraps[int(sequence)])
                    sequence_rows.append({"sequence": name, **head, **row})
    return {
        "settings": to_dict(settings),
        "sequences": [_sequence(run, number) for number in range(len(run.sequences))],
        "frontends": run.frontends,
        "gaps": [_average_relative_pose(run, gap) for gap in settings.gaps],
        "rows": rows,
        "sequence_rows": sequence_rows,
        "differences": differences,
        "curves": curves,
    }


def _row(records: Records, settings: PoseSettings, bootstrap: Bootstrap) -> dict[str, Any]:
    """One cell of Table 1 with all that explains it; every mean is over pairs and has its interval."""
    rotation, translation = records["rotation_deg"], records["translation_m"]
    row = {"pairs": len(records) // settings.shuffles, **_means(_of_pairs(records, settings), bootstrap)}
    failures = int(np.isinf(rotation).sum())  # without any pose; they count as failures everywhere
    row["failures"] = failures if settings.shuffles == 1 else failures / settings.shuffles
    row["median_rotation_deg"] = _finite(np.median(rotation))
    row["median_translation_m"] = _finite(np.median(translation))
    return row


def _difference(first: Records, second: Records, settings: PoseSettings, bootstrap: Bootstrap) -> dict[str, Any]:
    """Mean differences, second minus first, pair by pair: what is hard for both counts for neither."""
    before, after = _of_pairs(first, settings), _of_pairs(second, settings)
    return _means({name: after[name] - before[name] for name in before}, bootstrap)


def _means(values: dict[str, NDArray[Any]], bootstrap: Bootstrap) -> dict[str, Any]:
    """The mean of each of the values (N,), and its interval as `..._interval`."""
    row: dict[str, Any] = {}
    for name, of_pairs in values.items():
        row[name] = float(np.mean(of_pairs))
        row[f"{name}_interval"] = list(bootstrap.interval(of_pairs))
    return row


def _of_pairs(records: Records, settings: PoseSettings) -> dict[str, NDArray[Any]]:
    """What is averaged over pairs (N,), by name; of a pair's shuffles the mean."""
    rotation, translation = records["rotation_deg"], records["translation_m"]
    turned, moved = below(rotation, settings.max_rotation_deg), below(translation, settings.max_translation_m)
    strict, loose = (f"right_share_{limit:g}px" for limit in settings.right_px)
    values = {
        "rotation_success": turned,
        "translation_success": moved,
        "pose_success": turned & moved,
        "rotation_auc": area_shares(rotation, settings.curve_rotation_deg),
        "translation_auc": area_shares(translation, settings.curve_translation_m),
        "repeatability": share(records["repeated"], records["visible"]),
        "precision": share(records["right"], records["judged"]),
        "keypoints": records["keypoints"],
        "matches": records["matches"],
        "judged_matches": records["judged"],
        "right_matches": records["right"],
        "inliers": records["inliers"],
        "inlier_share": share(records["inliers"], records["judged"]),
        strict: share(records["right_strict"], records["judged"]),
        loose: share(records["right_loose"], records["judged"]),
    }
    return {name: of_records.reshape(-1, settings.shuffles).mean(axis=1) for name, of_records in values.items()}


def share(part: Any, whole: Any) -> Float64:
    """part / whole for each pair, 0 where there is nothing: a frontend that finds nothing is not left out."""
    return np.divide(part, whole, out=np.zeros(len(part)), where=whole > 0)


def _curves(records: Records, settings: PoseSettings) -> dict[str, Any]:
    degrees = np.linspace(0, settings.curve_rotation_deg, CURVE_POINTS)
    metres = np.linspace(0, settings.curve_translation_m, CURVE_POINTS)
    return {
        "rotation_deg": degrees.tolist(),
        "rotation_accuracy": accuracy_curve(records["rotation_deg"], degrees).tolist(),
        "translation_m": metres.tolist(),
        "translation_accuracy": accuracy_curve(records["translation_m"], metres).tolist(),
    }


def _average_relative_pose(run: PoseRun, gap: int) -> dict[str, Any]:
    """The true motion between the images of a pair, the second line of Table 1."""
    motions = np.concatenate([relative_motion(s.world_from_cam, s.pairs[gap]) for s in run.sequences])
    return {
        "gap": gap,
        "pairs": len(motions),
        "mean_rotation_deg": float(rotation_angle_deg(motions[:, :3, :3]).mean()),
        "mean_translation_m": float(np.linalg.norm(motions[:, :3, 3], axis=1).mean()),
    }


def _sequence(run: PoseRun, number: int) -> dict[str, Any]:
    sequence = run.sequences[number]
    unreadable = run.unreadable.get(sequence.name, ())
    return {
        "name": sequence.name,
        "path": sequence.path,
        "frames": sequence.frames,
        "pairs": {str(gap): len(pairs) for gap, pairs in sequence.pairs.items()},
        "invalid_poses": len(sequence.invalid_poses),
        "first_invalid_poses": list(sequence.invalid_poses[:NAMED_FRAMES]),
        "unreadable_frames": len(unreadable),
        "first_unreadable_frames": list(unreadable[:NAMED_FRAMES]),
    }


def _bootstrap(records: Records, settings: PoseSettings) -> Bootstrap:
    """Resamples of the pairs in `records`, the same for every frontend and solver; neighbours are drawn together."""
    once = records[(records["frontend"] == 0) & (records["estimator"] == 0) & (records["shuffle"] == 0)]
    block = overlapping(np.stack([once["a"], once["b"]], axis=1).astype(np.int64))
    return Bootstrap(len(once), settings.seed, settings.resamples, settings.confidence, block)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def write_records(run: PoseRun, path: Any) -> None:
    """`pairs.parquet`: one row per pair, frontend, estimator and shuffle; a failed pose has infinite errors."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    from improvo.files import written_atomically

    columns: dict[str, Any] = {name: run.records[name] for name in run.records.dtype.names or ()}
    names = {
        "sequence": [sequence.name for sequence in run.sequences],
        "frontend": run.frontends,
        "estimator": list(run.settings.estimators),
    }
    for column, values in names.items():
        columns[column] = pa.DictionaryArray.from_arrays(pa.array(columns[column]), pa.array(values))
    with written_atomically(path) as temporary:
        pq.write_table(pa.table(columns), temporary, compression="zstd")
