"""ROC curves and recall per cause as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import require_plots
from improvo.evaluation.plots import COLOURS
from improvo.evaluation.stability.causes import PRECEDENCE
from improvo.evaluation.stability.protocol import HEADLINE, ScoredPoints
from improvo.files import written_atomically


def draw_stability(scored: dict[str, ScoredPoints], results: dict[str, Any], path: Path) -> None:
    """Left: moving things and highlights against static points; right: recall and false alarms per true cause.

    Args:
        scored: subject name -> its points.
        results: content of `stability.json`.
        path: PNG to write.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    require_plots("pictures of curves")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    curves, bars = figure.subplots(1, 2)
    number = 0
    for name, points in scored.items():
        static = points.cause == PRECEDENCE.index("static")
        positive = np.isin(points.cause, [PRECEDENCE.index(cause) for cause in HEADLINE])
        for score_name, score in points.scores.items():
            false_rate, true_rate = roc_curve(score[positive], score[static])
            curves.plot(false_rate, true_rate, color=COLOURS[number % len(COLOURS)], label=f"{name}: {score_name}")
            number += 1
    curves.plot([0, 1], [0, 1], color="0.8", linewidth=0.8)
    curves.set(xlabel="static points called unstable", ylabel="moving and highlight points found", title="ROC")
    curves.legend(fontsize=8, loc="lower right")
    causes = [*PRECEDENCE[:-1], "static"]
    width = 0.8 / max(len(results["subjects"]), 1)
    for column, subject in enumerate(results["subjects"]):
        rows = {row["cause"]: row["recall"] for row in subject["causes"]} | {
            "static": subject["static"]["false_alarms"]
        }
        heights = [rows[cause] or 0.0 for cause in causes]
        place = np.arange(len(causes)) + (column - (len(results["subjects"]) - 1) / 2) * width
        bars.bar(place, heights, width, color=COLOURS[column % len(COLOURS)], label=subject["name"])
    bars.set_xticks(range(len(causes)), [cause.replace("_", "\n") for cause in causes], fontsize=8)
    bars.set(ylabel="share called unstable", ylim=(0, 1), title="by true cause, of the points with a label")
    bars.legend(fontsize=8)
    with written_atomically(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png", metadata={"Software": None})


def roc_curve(positive: np.ndarray, negative: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """False and true positive rates (K,), over all thresholds, from scores (P,) and (N,)."""
    thresholds = np.unique(np.concatenate([positive, negative]))
    sides = (negative, positive)
    rates = [1 - np.searchsorted(np.sort(s), thresholds, side="left") / max(len(s), 1) for s in sides]
    return np.append(rates[0], 0.0), np.append(rates[1], 0.0)
