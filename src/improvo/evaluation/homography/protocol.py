"""The homography protocol: repeatability, localisation, matching and homography accuracy (DeTone et al. 2018).

Every measure is taken in both directions where it has one, and only over keypoints that the other image shows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from improvo.config import to_dict
from improvo.evaluation.homography.pairs import Scene, open_scene
from improvo.evaluation.measures import squared_distances
from improvo.evaluation.settings import HomographySettings
from improvo.evaluation.sources import LoadedFrontend, refuse_equal_names
from improvo.evaluation.statistics import Bootstrap, average_precision
from improvo.evaluation.tables import bold_best, columns_to_rows, decimals, markdown
from improvo.jobs.pool import Workers
from improvo.tracking.matching import mutual_nearest_neighbours, unit_descriptors
from improvo.training.augmentation.views import inside, warp_points
from improvo.types import Features, Float64, Int64


@dataclass(frozen=True)
class HomographyTask:
    """One scene, for all frontends."""

    scene: Scene
    frontends: tuple[LoadedFrontend, ...]
    settings: HomographySettings


def evaluate_scene(task: HomographyTask) -> list[dict[str, Any]]:
    """Measures of each view and frontend."""
    reference, views = open_scene(task.scene, task.settings)
    rows = []
    for frontend in task.frontends:
        first = frontend.of_image(reference)
        for number, view in enumerate(views):
            second = frontend.of_image(view.image)
            measures = evaluate_pair(
                first, second, view.view_from_reference, reference.shape, view.image.shape, task.settings
            )
            head = {"scene": task.scene.name, "split": task.scene.split, "view": number, "frontend": frontend.label}
            rows.append({**head, **measures})
    return rows


def evaluate_pair(
    a: Features,
    b: Features,
    b_from_a: Float64,
    shape_a: tuple[int, ...],
    shape_b: tuple[int, ...],
    settings: HomographySettings,
) -> dict[str, float | None]:
    """All measures of one image pair.

    Args:
        a, b: features of the two images.
        b_from_a: (3, 3) true homography.
        shape_a, shape_b: (H, W) of the images.
        settings: thresholds.

    Returns:
        repeatability, localisation_error (px, None without a repeated keypoint), mean_average_precision,
        matching_score, corner_error (px, inf where no homography was found).
    """
    shared_a, shared_b, distance = correspondence(a, b, b_from_a, shape_a, shape_b)
    nearest = [distance.min(axis=axis, initial=np.inf) for axis in (1, 0)]
    repeated = [d[d < settings.max_error_px] for d in nearest]
    shown = len(shared_a) + len(shared_b)
    errors = np.concatenate(repeated)
    near = distance < settings.max_error_px
    a_shown, b_shown = a.take(shared_a), b.take(shared_b)
    similarity = unit_descriptors(a_shown) @ unit_descriptors(b_shown).T
    precision = [matching_precision(similarity, near), matching_precision(similarity.T, near.T)]
    matches = mutual_nearest_neighbours(a_shown, b_shown)
    right = int(near[matches[:, 0], matches[:, 1]].sum())
    return {
        "repeatability": len(errors) / shown if shown else 0.0,
        "localisation_error": float(errors.mean()) if len(errors) else None,
        "mean_average_precision": float(np.mean(precision)),
        "matching_score": 2.0 * right / shown if shown else 0.0,
        "corner_error": corner_error(a, b, b_from_a, shape_a, settings),
    }


def correspondence(
    a: Features, b: Features, b_from_a: Float64, shape_a: tuple[int, ...], shape_b: tuple[int, ...]
) -> tuple[Int64, Int64, Float64]:
    """Keypoints of each image that the other one shows, and their distances (N, M) in pixels of B.

    Args:
        a, b: features of the two images.
        b_from_a: (3, 3) true homography.
        shape_a, shape_b: (H, W) of the images.
    """
    in_b = warp_points(b_from_a, a.keypoints.astype(np.float64))
    in_a = warp_points(np.asarray(np.linalg.inv(b_from_a), np.float64), b.keypoints.astype(np.float64))
    shared_a = np.flatnonzero(inside(in_b, shape_b[1], shape_b[0]))
    shared_b = np.flatnonzero(inside(in_a, shape_a[1], shape_a[0]))
    distance = np.sqrt(squared_distances(in_b[shared_a], b.keypoints[shared_b].astype(np.float64)))
    return shared_a.astype(np.int64), shared_b.astype(np.int64), distance


def matching_precision(similarity: NDArray[np.floating], near: NDArray[np.bool_]) -> float:
    """Average precision of nearest-neighbour matches, accepted from the most similar on; 0 where none can be right.

    Args:
        similarity: (N, M) of descriptors.
        near: (N, M) whether two keypoints are the same point; recall counts the rows that have one.
    """
    if near.size == 0:
        return 0.0
    best, rows = similarity.argmax(axis=1), np.arange(len(similarity))
    possible = int(near.any(axis=1).sum())
    return average_precision(similarity[rows, best].astype(np.float64), near[rows, best], possible) or 0.0


def corner_error(
    a: Features, b: Features, b_from_a: Float64, shape_a: tuple[int, ...], settings: HomographySettings
) -> float:
    """Mean distance of the image's corners under the estimated and the true homography; inf where none was found.

    Args:
        a, b: features of the two images.
        b_from_a: (3, 3) true homography.
        shape_a: (H, W) of image A.
        settings: of the robust estimation.
    """
    import cv2

    matches = mutual_nearest_neighbours(a, b)
    if len(matches) < 4:
        return float("inf")
    cv2.setRNGSeed(settings.seed)
    estimate, _ = cv2.findHomography(
        a.keypoints[matches[:, 0]], b.keypoints[matches[:, 1]], cv2.RANSAC, settings.ransac_px
    )
    if estimate is None or not np.isfinite(estimate).all():
        return float("inf")
    height, width = shape_a[:2]
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], np.float64)
    error = np.linalg.norm(
        warp_points(np.asarray(estimate, np.float64), corners) - warp_points(b_from_a, corners), axis=1
    ).mean()
    return float(error) if np.isfinite(error) else float("inf")


def run_homography_protocol(
    scenes: list[Scene],
    frontends: list[LoadedFrontend],
    settings: HomographySettings,
    workers: Workers | None = None,
) -> dict[str, Any]:
    """The content of `homography.json`: `rows` per frontend and split, `pairs` with the measures of each pair.

    Args:
        scenes: image pairs.
        frontends: with different labels.
        settings: of the protocol.
        workers: processes; by default this one alone.

    Raises:
        InputError: an image or homography that cannot be read.
        ConfigError: two frontends of one label.
    """
    refuse_equal_names("frontends", [frontend.label for frontend in frontends])
    tasks = [HomographyTask(scene, tuple(frontends), settings) for scene in scenes]
    pairs = [row for rows in (workers or Workers()).run(evaluate_scene, tasks, "homography") for row in rows]
    splits = ["all", *sorted({scene.split for scene in scenes})]
    rows = []
    for split in splits if len(splits) > 2 else ["all"]:
        for frontend in frontends:
            own = [p for p in pairs if p["frontend"] == frontend.label and split in ("all", p["split"])]
            rows.append({"frontend": frontend.label, "split": split, "pairs": len(own), **_summary(own, settings)})
    for pair in pairs:
        pair["corner_error"] = pair["corner_error"] if np.isfinite(pair["corner_error"]) else None
    return {"settings": to_dict(settings), "rows": rows, "pairs": pairs}


def _summary(pairs: list[dict[str, Any]], settings: HomographySettings) -> dict[str, Any]:
    """Means over pairs with their intervals; the localisation error is over pairs that repeat a keypoint at all."""
    bootstrap = Bootstrap(len(pairs), settings.seed, settings.resamples, settings.confidence)
    corner = np.array([pair["corner_error"] for pair in pairs])
    columns: dict[str, NDArray[np.generic]] = {
        name: np.array([pair[name] for pair in pairs], np.float64)
        for name in ("repeatability", "mean_average_precision", "matching_score")
    }
    columns |= {f"homography_{limit:g}px": corner < limit for limit in settings.corner_errors_px}
    summary: dict[str, Any] = {}
    for name, values in columns.items():
        summary[name] = float(values.mean())
        summary[f"{name}_interval"] = list(bootstrap.interval(values))
    located = [pair["localisation_error"] for pair in pairs if pair["localisation_error"] is not None]
    summary["localisation_error"] = float(np.mean(located)) if located else None
    summary["failures"] = int(np.isinf(corner).sum())
    return summary


def homography_table(results: dict[str, Any]) -> str:
    """`homography.json` as Markdown, one table per split."""
    limits = [f"homography_{limit:g}px" for limit in results["settings"]["corner_errors_px"]]
    parts, skipped = [], results.get("skipped_frontends", ())
    for split in dict.fromkeys(row["split"] for row in results["rows"]):
        rows = [row for row in results["rows"] if row["split"] == split]
        header = [f"{split}: {rows[0]['pairs']} pairs", "repeatab.", "localis. (px)", "mAP", "matching"]
        header += [f"< {limit:g} px" for limit in results["settings"]["corner_errors_px"]]
        columns = []
        for field in ("repeatability", "localisation_error", "mean_average_precision", "matching_score", *limits):
            values = [row[field] for row in rows]
            cells = [decimals(value) for value in values]
            columns.append(bold_best(cells, values, largest=field != "localisation_error"))
        parts.append(markdown(header, columns_to_rows([row["frontend"] for row in rows], columns)))
    parts += ["\n".join(f"- frontend {s['frontend']} not run: {s['reason']}" for s in skipped)] if skipped else []
    return "\n\n".join(parts) + "\n"
