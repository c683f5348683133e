"""The solver against Ceres on the same windows: same optimum, time per iteration, time per new frame.

    python benchmarks/backend.py [--data FOLDER] [--frames N] [--json FILE]

Needs CMake, a C++ compiler and Ceres (apt-get install cmake g++ libceres-dev); the small program in benchmarks/ceres is
built by this script. All times are processor time of one thread, the least of several runs taken in turns. Ceres is
given its best case: -O3 -march=native for the program, analytic derivatives, its dense Schur complement, the faster of
Eigen and LAPACK for the reduced system. Setting up counts in neither time per iteration; in the time of a new frame
ours counts, and Ceres' does not, nor does its first evaluation. The exact objective has three residuals per observation
(u, v, and the depth excess under the same Huber loss); for the two that are left without the depth regulariser Debian's
Ceres has a specialised eliminator, and the second line of each table is that case.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

from backend_frames import first_window, ours, paper, position_error, slide
from backend_windows import Recording, cut_window, real_recording, simulated_recording
from ceres_program import CeresMissingError, build, solve_with_ceres
from improvo.backend import BundleProblem, ObjectiveSettings, SolverSettings, solve
from improvo.backend.compile import compile_kernels
from improvo.backend.solver import PARTS
from improvo.files import write_json

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
ITERATIONS = 15  # of the timed runs
REPEATS = 5
FREE, CONSTANT = 30, 30
TO_THE_END = 1e-14  # relative decrease
REDKITCHEN_STARTS = (240, 480)  # where half a second of the sequence has parallax for 600 points


def main() -> int:
    """Run, print the tables, write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    shared = Path(__file__).resolve().parents[2] / "shared" / "data"
    parser.add_argument("--data", type=Path, default=shared, help="folder that holds redkitchen")
    parser.add_argument("--frames", type=int, default=30, help="new frames of the frame-by-frame comparison")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    if any(os.environ.get(name) != value for name, value in ONE_THREAD.items()):  # BLAS reads them when it is loaded
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **ONE_THREAD})
    compile_kernels(lambda message: print(message, file=sys.stderr))
    with tempfile.TemporaryDirectory() as folder:
        try:
            program = build(Path(folder))
        except CeresMissingError as error:
            print(f"benchmarks/backend.py: {error}", file=sys.stderr)
            return 2
        frames = FREE + max(arguments.frames, CONSTANT)
        recordings = [simulated_recording(frames, 20 * frames, seed=0, outliers=0.03)]
        kitchen = arguments.data / "redkitchen"
        if kitchen.is_dir():
            recordings += [real_recording(kitchen, start, frames) for start in REDKITCHEN_STARTS]
        else:
            print(f"{kitchen}: not there, simulated windows only (--data FOLDER)", file=sys.stderr)
        windows = [_compare_windows(program, recording) for recording in recordings]
        slides = [_compare_frames(program, recording, arguments.frames) for recording in recordings]
    rows = [row for group in windows for row in group]
    figures = {
        "iteration_speedup": min(row["iteration_speedup"] for row in rows),
        "frame_speedup": min(row["frame_speedup"] for row in slides),
        "cost_difference": max(row["cost_difference"] for row in rows),
        "threads": 1,
        "ceres": rows[0]["ceres_version"],
        "windows": rows,
        "frames": slides,
    }
    print(f"\n1 thread each, processor time; Ceres {figures['ceres']}")
    print(f"iteration_speedup {figures['iteration_speedup']:.1f} (least of the windows, the exact objective)")
    print(f"frame_speedup     {figures['frame_speedup']:.1f} (least of the recordings)")
    print(f"cost_difference   {figures['cost_difference']:.1e} (largest, relative, at convergence)")
    if arguments.json:
        write_json(arguments.json, figures)
    return 0


def _compare_windows(program: Path, recording: Recording) -> list[dict[str, object]]:
    """30 free poses, alone and with 30 constant ones before them."""
    rows = []
    for constant, points in ((0, 600), (CONSTANT, 800)):
        problem = cut_window(recording, FREE, constant, points, seed=0)
        free = int((~problem.fixed_cameras[problem.camera_index]).sum())
        row = {
            "window": f"{recording.name}, {FREE} poses" + (f" + {constant} constant" if constant else ""),
            "points": len(problem.points),
            "observations": [free, len(problem.weights) - free],
            **_compare_optima(program, problem),
            **_compare_speed(program, problem),
        }
        _print_window(row)
        rows.append(row)
    return rows


def _compare_optima(program: Path, problem: BundleProblem) -> dict[str, object]:
    """Both to the end from the same start, with the exact objective."""
    objective = ObjectiveSettings()
    theirs = solve_with_ceres(program, problem, objective, 2000, TO_THE_END)
    mine = solve(problem, objective, SolverSettings(max_iterations=2000, relative_decrease=TO_THE_END))
    return {
        "start_difference": abs(theirs.initial_cost - mine.initial_cost) / mine.initial_cost,
        "cost_difference": abs(theirs.cost - mine.cost) / mine.cost,
        "cost": mine.cost,
        "iterations_to_the_end": {"ceres": theirs.iterations, "improvo": mine.iterations},
        "ceres_version": theirs.version,
    }


def _compare_speed(program: Path, problem: BundleProblem) -> dict[str, object]:
    """Milliseconds per iteration at an equal number of iterations, in turns, the least of several runs."""
    exact, plain = ObjectiveSettings(), ObjectiveSettings(depth_weight=0.0)
    settings = SolverSettings(max_iterations=ITERATIONS, relative_decrease=0.0)
    variants = [(exact, 3, False), (exact, 3, True), (plain, 2, False), (plain, 2, True)]
    theirs = {"exact": np.inf, "plain": np.inf}
    mine: dict[str, tuple[float, dict[str, float]]] = {}
    parts: dict[str, float] = {}
    threads = 0
    for _ in range(REPEATS):
        for objective, rows, lapack in variants:
            kind = "exact" if rows == 3 else "plain"
            result = solve_with_ceres(program, problem, objective, ITERATIONS, -1.0, rows, lapack)
            if result.seconds / result.iterations < theirs[kind]:
                theirs[kind] = result.seconds / result.iterations
                parts = {k: 1e3 * v / result.iterations for k, v in result.parts.items()} if rows == 3 else parts
            threads = max(threads, result.threads)
        for kind, objective in 2 * [("exact", exact), ("plain", plain)]:
            timed = solve(problem, objective, settings, timed=True)
            seconds = (sum(timed.seconds.values()) - timed.seconds["arrange"]) / timed.iterations
            if kind not in mine or seconds < mine[kind][0]:
                mine[kind] = seconds, {part: 1e3 * timed.seconds[part] / timed.iterations for part in PARTS}
    return {
        "iteration_speedup": theirs["exact"] / mine["exact"][0],
        "iteration_speedup_without_regulariser": theirs["plain"] / mine["plain"][0],
        "ceres_ms": {kind: 1e3 * value for kind, value in theirs.items()},
        "improvo_ms": {kind: 1e3 * value[0] for kind, value in mine.items()},
        "ceres_parts_ms": parts,
        "improvo_parts_ms": mine["exact"][1],
        "ceres_threads": threads,
    }


def _print_window(row: dict[str, object]) -> None:
    ceres, improvo = row["ceres_ms"], row["improvo_ms"]
    print(
        f"\n{row['window']}: {row['points']} points, {row['observations'][0]} + {row['observations'][1]} observations"
    )
    print(
        f"  to the end: cost {row['cost']:.6f}, relative difference {row['cost_difference']:.1e}, "
        f"iterations Ceres {row['iterations_to_the_end']['ceres']}, improvo {row['iterations_to_the_end']['improvo']}"
    )
    print(f"  ms per iteration, 1 thread       Ceres {row['ceres_version']}      improvo    ratio")
    for kind, label in (("exact", "exact objective"), ("plain", "without depth regulariser")):
        print(f"    {label:28s} {ceres[kind]:10.2f} {improvo[kind]:9.2f} {ceres[kind] / improvo[kind]:8.1f}")
    for label, parts in (("improvo", row["improvo_parts_ms"]), ("Ceres, its own wall clock", row["ceres_parts_ms"])):
        print(f"    {label}: " + ", ".join(f"{part} {ms:.3f}" for part, ms in parts.items()))


def _compare_frames(program: Path, recording: Recording, frames: int) -> dict[str, object]:
    """Both procedures over the same new frames, from the same first window."""
    objective = ObjectiveSettings()
    start = first_window(recording)
    new = range(FREE, FREE + frames)
    slide(start, range(FREE, FREE + 2), ours)  # warm caches
    mine = slide(start, new, ours)
    theirs = slide(start, new, paper(lambda problem: solve_with_ceres(program, problem, objective)))
    row = {
        "recording": recording.name,
        "frames": frames,
        "frame_speedup": float(np.median(theirs.seconds) / np.median(mine.seconds)),
        "paper_ms": 1e3 * float(np.median(theirs.seconds)),
        "improvo_ms": 1e3 * float(np.median(mine.seconds)),
        "paper_iterations": float(np.mean(theirs.iterations)),
        "improvo_iterations": float(np.mean(mine.iterations)),
        "paper_error_percent": position_error(theirs, new),
        "improvo_error_percent": position_error(mine, new),
    }
    print(f"\n{recording.name}, {frames} new frames one by one: median ms, iterations, position error (% of path)")
    for label, key in (("paper's procedure with Ceres", "paper"), ("improvo", "improvo")):
        figures = row[f"{key}_ms"], row[f"{key}_iterations"], row[f"{key}_error_percent"]
        print("  {:30s} {:8.1f} {:6.1f} {:7.2f}".format(label, *figures))
    print(f"  ratio {row['frame_speedup']:33.1f}")
    return row


if __name__ == "__main__":
    sys.exit(main())
