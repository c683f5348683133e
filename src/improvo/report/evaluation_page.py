"""`report.html` of an evaluation: its tables, its curves, and the meaning of the numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from improvo.errors import InputError
from improvo.report.page import Page, as_json
from improvo.untrusted.paths import check_is_file
from improvo.untrusted.text import read_json_file, reason

# evaluation -> (title, what the numbers mean)
EVALUATIONS = {
    "pose": (
        "Pose estimation from 3D-to-2D matches",
        "The share of image pairs whose relative pose is right, by frontend and solver (paper, Table 1). A frontend is "
        "better only if it is better under the robust solver too: the solver moves this table more than the frontend.",
    ),
    "trajectory": (
        "Trajectory against ground truth",
        "Errors after alignment, over the whole path (ATE) and over stretches of fixed duration (paper, Table 2).",
    ),
    "vo": (
        "Visual odometry with and without stability",
        "Relative errors over stretches of the trajectory, with observations weighed by stability or all alike (paper, "
        "Table 2).",
    ),
    "homography": (
        "Homography estimation",
        "How well keypoints repeat and match between pictures of a plane, and how right the estimated homography is.",
    ),
    "stability": (
        "Instability against its true cause",
        "In simulation it is known what makes a point unstable; this counts how often label and classifier agree.",
    ),
}


def write_evaluation_page(folder: Path, path: Path) -> None:
    """Write the page of every evaluation that the folder holds.

    Raises:
        InputError: it holds none, or one that cannot be read.
    """
    found = [name for name in EVALUATIONS if (folder / f"{name}.json").is_file()]
    if not found:
        raise InputError(f"{folder}: has no results of `improvo evaluate`; check the folder")
    subjects = {name: _subject(folder / f"{name}.json") for name in found}
    what = EVALUATIONS[found[0]][0] if len(found) == 1 else "Evaluation"
    of = next((subject for subject in subjects.values() if subject), folder.name)
    page = Page(f"{what}: {of}", "Results of `improvo evaluate`.")
    for name in found:
        title, meaning = EVALUATIONS[name]
        if len(found) > 1:
            page.heading(title)
        page.paragraph(meaning)
        _tables(page, folder, name)
    for picture in sorted(folder.glob("*.png")):
        page.picture(picture, f"{picture.stem.replace('-', ', ')}: accuracy over thresholds; further up is better.")
    for name in found:
        page.details(f"{name}.json", _indented(folder / f"{name}.json"))
    page.write(path)


def _tables(page: Page, folder: Path, name: str) -> None:
    path, mend = folder / f"{name}.md", f"run `improvo evaluate {name}` again"
    try:
        text = check_is_file(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: is missing; {mend}") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: is damaged ({reason(error)}); {mend}") from None
    page.markdown(text)


def _subject(path: Path) -> str:
    """What was evaluated, in a few words: the recordings, or the estimate."""
    results = _read(path)
    entries = results.get("sequences") or results.get("sequence_rows") or []
    entries = entries if isinstance(entries, list) else []
    found = [entry.get("name") or entry.get("sequence") for entry in entries if isinstance(entry, dict)]
    names = list(dict.fromkeys(str(name) for name in found if name))
    if names:
        return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    estimate = Path(str(results.get("estimate", "")))
    return estimate.parent.name if estimate.name == "trajectory.txt" else estimate.name


def _read(path: Path) -> dict[str, Any]:
    """The results.

    Raises:
        InputError: missing, or damaged.
    """
    mend = "run the evaluation again"
    try:
        return read_json_file(path, mend)
    except FileNotFoundError:
        raise InputError(f"{path}: is missing; {mend}") from None


_LONGEST = 200_000  # characters of a result that are worth embedding


def _indented(path: Path) -> str:
    text = as_json(_read(path))
    return text if len(text) <= _LONGEST else text[:_LONGEST] + f"\n... {len(text) - _LONGEST} more characters"
