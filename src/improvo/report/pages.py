"""The page that fits an output folder."""

from __future__ import annotations

from pathlib import Path

from improvo.errors import ConfigError, InputError
from improvo.report.palettes import PALETTES, Palette


def write_report(
    folder: Path, path: Path, palette: Palette = PALETTES["paper"], sequence_path: Path | None = None
) -> None:
    """Write `report.html` of an output folder of `improvo run`, `label` or `evaluate`.

    Args:
        folder: the output folder.
        path: the HTML file.
        palette: of the pictures.
        sequence_path: where the recording of a run is now.

    Raises:
        InputError: the folder has no results that a page can be made of.
        ConfigError: the place of a recording, for what is no run.
    """
    if sequence_path is not None and not (folder / "run.json").is_file():
        raise ConfigError(f"--sequence {sequence_path}: belongs to the folder of a run, and {folder} is none")
    if (folder / "run.json").is_file():
        from improvo.odometry.run.run_folder import RunFolder
        from improvo.report.run_page import write_run_page

        write_run_page(RunFolder(folder, sequence_path), path, palette)
    elif (folder / "manifest.parquet").is_file():
        from improvo.report.label_page import write_label_page

        write_label_page(folder, path, palette)
    elif any((folder / name).is_file() for name in _evaluations()):
        from improvo.report.evaluation_page import write_evaluation_page

        write_evaluation_page(folder, path)
    else:
        raise InputError(f"{folder}: has no results of `improvo run`, `label` or `evaluate`; check the folder")


def _evaluations() -> tuple[str, ...]:
    from improvo.report.evaluation_page import EVALUATIONS

    return tuple(f"{name}.json" for name in EVALUATIONS)
