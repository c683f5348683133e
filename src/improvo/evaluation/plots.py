"""Accuracy over thresholds as a picture (paper, Figure "3D Pose Estimation Comparison")."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from improvo.errors import require_plots
from improvo.files import written_atomically

# Okabe and Ito's colours, told apart by colour-blind readers and in print; then line styles repeat them.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#999933")
STYLES = ("-", "--", ":")


def draw_pose_curves(results: dict[str, Any], estimator: str, path: Path) -> None:
    """Rotation and translation accuracy over thresholds, a column per gap, for one solver.

    Args:
        results: content of `pose.json`.
        estimator: the solver.
        path: PNG to write.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    require_plots("pictures of curves")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    settings = results["settings"]
    gaps, frontends = settings["gaps"], results["frontends"]
    pose = {entry["gap"]: entry for entry in results["gaps"]}
    figure = Figure(figsize=(1.2 + 3.3 * len(gaps), 7.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(gaps), squeeze=False, sharey=True)
    for column, gap in enumerate(gaps):
        curves = {c["frontend"]: c for c in results["curves"] if (c["estimator"], c["gap"]) == (estimator, gap)}
        rows = {r["frontend"]: r for r in results["rows"] if (r["estimator"], r["gap"]) == (estimator, gap)}
        kinds = (("rotation", "rotation_deg", 1.0), ("translation", "translation_m", 100.0))
        for axis, (kind, threshold, unit) in zip(axes[:, column], kinds, strict=True):
            for number, frontend in enumerate(frontends):
                curve, area = curves[frontend], rows[frontend][f"{kind}_auc"]
                style = STYLES[number // len(COLOURS) % len(STYLES)]
                x = [unit * value for value in curve[threshold]]
                axis.plot(
                    x,
                    curve[f"{kind}_accuracy"],
                    style,
                    color=COLOURS[number % len(COLOURS)],
                    label=f"{frontend} ({area:.2f})",
                    linewidth=1.6,
                )
            limit = unit * settings["max_rotation_deg" if kind == "rotation" else "max_translation_m"]
            axis.axvline(limit, color="0.6", linewidth=0.8, zorder=0)
            axis.set_xlim(0, x[-1])
            axis.set_ylim(0, 1.02)
            axis.grid(color="0.9")
            axis.set_xlabel(f"{kind} error threshold ({'degrees' if kind == 'rotation' else 'cm'})")
            axis.legend(
                fontsize=7,
                title="area under curve",
                title_fontsize=7,
                loc="upper center",
                bbox_to_anchor=(0.5, -0.17),
                ncol=3,
                frameon=False,
            )
        average = pose[gap]
        axes[0, column].set_title(
            f"gap {gap}: {average['mean_rotation_deg']:.0f}°, {100 * average['mean_translation_m']:.0f} cm on average"
            f"\n{average['pairs']} pairs",
            fontsize=9,
        )
    for axis in axes[:, 0]:
        axis.set_ylabel("share of pairs below")
    names = ", ".join(sequence["name"] for sequence in results["sequences"][:4])
    more = " …" if len(results["sequences"]) > 4 else ""
    figure.suptitle(f"Pose estimation accuracy, solver {estimator}: {names}{more}", fontsize=11)
    with written_atomically(path) as temporary:
        figure.savefig(temporary, dpi=130, format="png", metadata={"Software": None})
