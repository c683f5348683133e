"""`--camera auto` of every command that reads recordings: the camera is found before they are opened."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from improvo.cli.output import notice, say

if TYPE_CHECKING:
    from improvo.errors import InputError
    from improvo.self_calibration.from_motion import CameraFromMotion

T = TypeVar("T")


def with_found_camera(settings: T, recordings: Sequence[Path], folder: Path | None, command: str) -> T:
    """Settings of a command in which `--camera auto` has become a file.

    Args:
        settings: with a section `sequence`; returned as they are where another camera is given.
        recordings: paths.
        folder: of the command's output, where the cameras are left; None is the user's cache, where later commands
            on the same recordings find them too.
        command: that the folder belongs to.

    Raises:
        InputError: no recording tells its camera; a folder that was not there is not there then.
        OutputError: the folder cannot be used.
    """
    from improvo.sequences.rates import AUTO

    sequence = getattr(settings, "sequence")  # noqa: B009 - T has no bound that says so
    if sequence.camera != AUTO:
        return settings
    from improvo.errors import InputError
    from improvo.files import make_output_folder, remove_unused_folder
    from improvo.odometry.run.compile import compile_odometry
    from improvo.self_calibration.found_cameras import find_cameras
    from improvo.terminal import stages

    cache = _cache_of(recordings)
    kept = _made(cache) if folder is None else folder
    new = folder is not None and not folder.exists()
    if folder is not None:
        make_output_folder(folder, command)
    compile_odometry(notice)
    try:
        with stages("step") as told:
            found = find_cameras(recordings, sequence, kept, told=told, on_found=_say, before=cache)
    except InputError:
        if new:
            remove_unused_folder(kept)
        raise
    changed: T = dataclasses.replace(settings, sequence=found)  # type: ignore[type-var]
    return changed


def summary(found: CameraFromMotion) -> str:
    """A found camera in one line."""
    camera = found.camera
    return (
        f"camera from the motion: {camera.distortion_model}, fx {camera.fx:.1f}, fy {camera.fy:.1f} "
        f"(+- {100 * found.focal_deviation:.2g} %), {found.fov:.0f} degrees wide, RMS {found.rms:.2f} px"
    )


def _say(path: Path, found: CameraFromMotion | InputError | None) -> None:
    from improvo.self_calibration.from_motion import CameraFromMotion

    if isinstance(found, CameraFromMotion):
        say(f"{path.name}: {summary(found)}")
    elif found is not None:
        notice(f"no camera: {found}")


def _cache_of(recordings: Sequence[Path]) -> Path:
    """The folder of the user's cache for the cameras of these recordings; it need not be there."""
    import hashlib

    from improvo.cli.main import cache_folder

    names = "\n".join(str(path.absolute()) for path in recordings)
    return cache_folder() / "cameras" / hashlib.sha256(names.encode("utf-8", "surrogateescape")).hexdigest()[:16]


def _made(folder: Path) -> Path:
    from improvo.errors import OutputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({error.strerror}); give --camera FILE") from None
    return folder
