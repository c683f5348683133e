"""The pose protocol's results as Markdown, laid out like the paper's Table 1."""

from __future__ import annotations

import itertools
import math
from typing import Any

from improvo.evaluation.settings import ESTIMATORS
from improvo.evaluation.tables import bold_best, columns_to_rows, decimals, markdown
from improvo.terminal import counted


def pose_tables(results: dict[str, Any], sequences: bool = False) -> str:
    """`pose.json` as Markdown: Table 1 per solver, the intervals of its cells, and what lies behind them.

    Args:
        results: content of `pose.json`.
        sequences: add Table 1 for each sequence.
    """
    settings = results["settings"]
    parts = [_setup(results)]
    for estimator in settings["estimators"]:
        parts += [f"### Pose estimation, solver {estimator}", _table_1(results, results["rows"], estimator)]
        parts.append(
            f"{100 * settings['confidence']:.0f} % bootstrap intervals of the same cells, and of both at once:"
        )
        parts.append(_intervals(results, estimator, _SUCCESSES))
    shares = _right_shares(results)
    if shares:
        parts += ["### Right matches, less noisy than success", _shares_table(results, results["rows"])]
        names = {field: f"< {limit:g} px" for field, limit in shares.items()}
        parts.append(_intervals(results, settings["estimators"][0], names))
    if results.get("differences"):
        first = results["frontends"][0]
        parts.append(f"### Differences to {first}, on the same pairs (bold where the interval leaves out zero)")
        parts += [_differences(results, estimator) for estimator in settings["estimators"]]
    limit = f"{settings['max_error_px']:g} px"
    parts.append(f"### Matching (matches with depth; repeated and right below {limit})")
    parts += [_matching(results, gap) for gap in settings["gaps"]]
    if sequences:
        for sequence in results["sequences"]:
            rows = [row for row in results["sequence_rows"] if row["sequence"] == sequence["name"]]
            for estimator in settings["estimators"]:
                parts += [f"### {sequence['name']}, solver {estimator}", _table_1(results, rows, estimator)]
            parts += [_shares_table(results, rows)] if shares else []
    return "\n\n".join(parts) + "\n"


def check_results(results: dict[str, Any]) -> None:
    """Look whether the content of a `pose.json` has all that tables and curves need.

    Raises:
        LookupError, TypeError, ValueError, AttributeError, ArithmeticError: it has not.
    """
    settings, frontends = results["settings"], results["frontends"]
    if not settings["estimators"] or not set(settings["estimators"]) <= set(ESTIMATORS):  # they become names of files
        raise ValueError("unknown solvers")
    pose_tables(results, sequences=True)
    curves = {(curve["frontend"], curve["estimator"], curve["gap"]): curve for curve in results["curves"]}
    for key in itertools.product(frontends, settings["estimators"], settings["gaps"]):
        for kind, threshold in (("rotation", "rotation_deg"), ("translation", "translation_m")):
            x, y = curves[key][threshold], curves[key][f"{kind}_accuracy"]
            if len(x) != len(y) or not x or not all(isinstance(value, int | float) for value in (*x, *y)):
                raise ValueError("curves that are no numbers")
            limits = (settings["max_rotation_deg"], settings["max_translation_m"])
            if not math.isfinite(sum(map(float, (*x, *y, *limits)))):
                raise ValueError("numbers that are not finite")
            float(_cell(results["rows"], *key, f"{kind}_auc"))


def _setup(results: dict[str, Any]) -> str:
    settings = results["settings"]
    lines = []
    for sequence in results["sequences"]:
        pairs = ", ".join(f"{count} at gap {gap}" for gap, count in sequence["pairs"].items())
        line = f"- {sequence['name']}: {sequence['frames']} frames, pairs: {pairs}"
        for kind, what in (
            ("invalid_poses", "without a valid true pose"),
            ("unreadable_frames", "that cannot be decoded"),
        ):
            if sequence[kind]:
                named = ", ".join(map(str, sequence[f"first_{kind}"]))
                more = ", …" if sequence[kind] > len(sequence[f"first_{kind}"]) else ""
                line += f"; left out {counted(sequence[kind], 'frame')} {what} ({named}{more})"
        lines.append(line)
    lines += [f"- frontend {s['frontend']} not run: {s['reason']}" for s in results.get("skipped_frontends", ())]
    rules = [
        f"At most {settings['max_keypoints']} keypoints, mutual nearest neighbours",
        f"{settings['depth_sampling']} depth, seed {settings['seed']}; success is strictly below",
    ]
    shuffles = settings.get("shuffles", 1)
    rules += [f"mean over {shuffles} orders of each pair's matches"] if shuffles > 1 else []
    limits = f"{settings['max_rotation_deg']:g}° and {100 * settings['max_translation_m']:g} cm."
    return f"{', '.join(rules)} {limits}\n\n" + "\n".join(lines)


def _cell(rows: list[dict[str, Any]], frontend: str, estimator: str, gap: int, field: str) -> Any:
    for row in rows:
        if (row["frontend"], row["estimator"], row["gap"]) == (frontend, estimator, gap):
            return row[field]
    return None


def _table_1(results: dict[str, Any], rows: list[dict[str, Any]], estimator: str) -> str:
    """The paper's Table 1, for one solver."""
    settings, frontends = results["settings"], results["frontends"]
    gaps = settings["gaps"]
    pose = {entry["gap"]: entry for entry in results["gaps"]}
    header = ["Frame difference", *(str(gap) for _ in range(2) for gap in gaps)]
    average = ["Average relative pose", *(f"{pose[gap]['mean_rotation_deg']:.0f}°" for gap in gaps)]
    average += [f"{100 * pose[gap]['mean_translation_m']:.0f} cm" for gap in gaps]
    rotation = f"Rot. < {settings['max_rotation_deg']:g}°"
    translation = f"Transl. < {100 * settings['max_translation_m']:g} cm"
    legend = ["", *(name for name in (rotation, translation) for _ in gaps)]
    columns = []
    for field in ("rotation_success", "translation_success"):
        for gap in gaps:
            values = [_cell(rows, frontend, estimator, gap, field) for frontend in frontends]
            columns.append(bold_best([decimals(value) for value in values], values))
    shown = [average, legend] if rows is results["rows"] else [legend]
    return markdown(header, [*shown, *columns_to_rows(frontends, columns)])


def _shares_table(results: dict[str, Any], rows: list[dict[str, Any]]) -> str:
    """Shares of right matches; they are the same for every solver."""
    settings, frontends, shares = results["settings"], results["frontends"], _right_shares(results)
    gaps, solver = settings["gaps"], settings["estimators"][0]
    header = ["Frame difference", *(str(gap) for _ in shares for gap in gaps)]
    legend = ["", *(f"Right < {limit:g} px" for limit in shares.values() for _ in gaps)]
    columns = []
    for field in shares:
        for gap in gaps:
            values = [_cell(rows, frontend, solver, gap, field) for frontend in frontends]
            columns.append(bold_best([decimals(value) for value in values], values))
    return markdown(header, [legend, *columns_to_rows(frontends, columns)])


def _right_shares(results: dict[str, Any]) -> dict[str, float]:
    """Names of the shares of right matches and their limits in pixels; none in results of earlier versions."""
    return {f"right_share_{limit:g}px": limit for limit in results["settings"].get("right_px", ())}


_SUCCESSES = {"rotation_success": "rot.", "translation_success": "transl.", "pose_success": "both"}


def _intervals(results: dict[str, Any], estimator: str, fields: dict[str, str]) -> str:
    gaps, frontends = results["settings"]["gaps"], results["frontends"]
    header, columns = [""], []
    for field, name in fields.items():
        for gap in gaps:
            header.append(f"{name} {gap}")
            spans = [_cell(results["rows"], frontend, estimator, gap, f"{field}_interval") for frontend in frontends]
            columns.append([f"{decimals(low, 2)}-{decimals(high, 2)}" for low, high in spans])
    return markdown(header, columns_to_rows(frontends, columns))


def _differences(results: dict[str, Any], estimator: str) -> str:
    """What each frontend but the first adds to the first, with the interval over pairs."""
    fields = {
        "rotation_success": "rot.",
        "translation_success": "transl.",
        "rotation_auc": "rot. area",
        "translation_auc": "transl. area",
        "precision": "precision",
        **{field: f"right < {limit:g} px" for field, limit in _right_shares(results).items()},
        "inlier_share": "inliers / matches",
    }
    if _right_shares(results):  # the same at max_error_px
        del fields["precision"]
    chosen = [row for row in results["differences"] if row["estimator"] == estimator]

    def cell(row: dict[str, Any], field: str) -> str:
        low, high = row[f"{field}_interval"]
        text = f"{row[field]:+.3f} ({low:+.3f} to {high:+.3f})"
        return f"**{text}**" if low > 0 or high < 0 else text

    rows = [[f"{row['frontend']}, gap {row['gap']}", *(cell(row, field) for field in fields)] for row in chosen]
    return markdown([estimator, *fields.values()], rows)


def _matching(results: dict[str, Any], gap: int) -> str:
    """Repeatability, precision, match counts and inliers at one gap, means over pairs."""
    settings, frontends, rows = results["settings"], results["frontends"], results["rows"]
    solvers = settings["estimators"]
    fields = [
        ("repeatability", solvers[0], "repeatability", 3),
        ("precision", solvers[0], "precision", 3),
        ("keypoints", solvers[0], "keypoints", 0),
        ("judged_matches", solvers[0], "matches", 0),
        ("right_matches", solvers[0], "right", 0),
        *(("inliers", solver, f"inliers {solver}", 0) for solver in solvers),
    ]
    header, columns = [f"Gap {gap}"], []
    for field, solver, name, places in fields:
        header.append(name)
        values = [_cell(rows, frontend, solver, gap, field) for frontend in frontends]
        columns.append([decimals(value, places) for value in values])
    return markdown(header, columns_to_rows(frontends, columns))
