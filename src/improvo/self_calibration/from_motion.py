"""A camera from the motion of a video, or a plain word on why this motion cannot give one."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import InputError
from improvo.files import write_json, write_text
from improvo.frontend.registry import frontend_from
from improvo.geometry.camera import Camera
from improvo.geometry.camera_files import calibration_yaml
from improvo.self_calibration.adjustment import Adjusted, Scene, adjust, adjusted, outlier_cost
from improvo.self_calibration.first_guess import Guess, agreement, far_pairs, guesses
from improvo.self_calibration.lens import MODELS, NAMES, Lens
from improvo.self_calibration.raw_features import Piece, detect_pieces, open_raw, piece_rows
from improvo.self_calibration.settings import SelfCalibrationSettings
from improvo.self_calibration.tracked import TrackedPiece, scene_of, track_piece
from improvo.terminal import counted
from improvo.types import Mask

_MIN_FRAMES = 20
_MIN_PAIRS = 2
_MIN_VIEWS = 5
_MIN_POINTS = 60
_ROUGH = 15  # iterations, before outliers are left out
_OUTLIER = 4.0  # pixels; observations over it take no part in the last adjustment
# on the deviations, for what neither lens nor shutter explains: with it, the truth of all recordings in docs/cameras.md
# lies within three of them
_CAUTION = 1.5
_SETTLED = 0.004  # relative change of the focal length at which rounds end
_FURTHER_GUESSES = 2  # that are tried where the best one gives no map
_SIMPLER = 0.97  # fisheye is taken if it lowers the cost below this share
_BETTER_GUESS = 0.03  # of agreement, by which another guess refutes what was found

Told = Callable[[str, int, int], None]  # stage, done, of how many


@dataclass(frozen=True)
class CameraFromMotion:
    """A camera that was found from a video, and how sure it is."""

    camera: Camera  # of the raw pictures
    deviations: dict[str, float]  # fx, fy, cx, cy (pixels), k1, k2 -> standard deviation
    rms: float  # pixels, re-projection error
    frames: int  # looked at
    tracked: int  # of them with a pose
    views: int  # adjusted together with the camera
    points: int
    observations: int
    fov: float  # degrees, horizontally
    readout: float  # seconds between the first and the last row of a picture: 0 unless the shutter is rolling
    readout_deviation: float  # seconds

    @property
    def focal_deviation(self) -> float:
        """The standard deviation of the focal length as a share of it."""
        return max(self.deviations["fx"] / self.camera.fx, self.deviations["fy"] / self.camera.fy)

    @property
    def values(self) -> dict[str, float]:
        """The six numbers that were looked for."""
        camera = self.camera
        k1, k2 = camera.distortion[:2]
        return dict(zip(NAMES, (camera.fx, camera.fy, camera.cx, camera.cy, k1, k2), strict=True))

    @property
    def figures(self) -> dict[str, Any]:
        """Everything as plain JSON."""
        names = ["deviations", "readout", "readout_deviation", "rms", "fov", "frames", "tracked", "views", "points"]
        names.append("observations")
        camera = {"width": self.camera.width, "height": self.camera.height, "model": self.camera.distortion_model}
        return {**camera, "values": self.values, **{name: getattr(self, name) for name in names}}

    def write(self, path: Path | str, request: dict[str, Any] | None = None) -> None:
        """`camera.yaml` with the deviations as a comment, and all figures beside it as JSON.

        Args:
            path: of the YAML file.
            request: what was asked for, to know the file again.

        Raises:
            OutputError: it cannot be written.
        """
        path = Path(path)
        deviations = ", ".join(f"{name} {value:.2g}" for name, value in self.deviations.items())
        comment = (
            f"# from the motion of {self.tracked} frames ({self.views} views adjusted): RMS {self.rms:.3f} px; "
            f"standard deviations {deviations}\n"
        )
        with suppress(OSError):  # a stop between the two files must not leave those of different recordings
            path.with_suffix(".json").unlink(missing_ok=True)
        write_text(path, comment + calibration_yaml(self.camera))
        write_json(path.with_suffix(".json"), {"found": self.figures, "request": request or {}})


def camera_from_motion(
    path: Path | str, settings: SelfCalibrationSettings | None = None, told: Told = lambda stage, done, total: None
) -> CameraFromMotion:
    """Find the camera of a recording from its motion: focal lengths, principal point, two radial coefficients.

    Keypoints are detected on the raw pictures once. Pairs of frames choose a first guess among fields of view and
    distortions. Then the odometry runs with the guess, and the lens is adjusted together with views and points; both
    are repeated with the better lens.

    Args:
        path: anything that `open_sequence` opens; a calibration of its own is not looked at.
        settings: all numbers.
        told: is called with a stage in words, and how far it is.

    Raises:
        InputError: the recording cannot be read, or its motion leaves the camera open: it hardly moves, only turns,
            only goes forward, or shows too little.
    """
    settings = settings or SelfCalibrationSettings()
    sequence = open_raw(path, settings.sequence, settings.max_width)
    name, size = str(path), (sequence.raw_camera.width, sequence.raw_camera.height)
    if len(sequence) < _MIN_FRAMES:
        raise InputError(
            f"{name}: has {counted(len(sequence), 'frame')}; finding its camera needs at least {_MIN_FRAMES}"
        )
    rows = piece_rows(sequence.times, settings.frames, settings.pieces, settings.max_rate)
    total, done = sum(map(len, rows)), 0

    def detected() -> None:
        nonlocal done
        done += 1
        told("keypoints", done, total)

    pieces = detect_pieces(sequence, rows, frontend_from(settings.frontend), detected)
    found = lens_of_pieces(pieces, sequence.camera.width, sequence.camera.height, settings, name, told)
    lens = found.adjusted.scene.lens
    scale = size[0] / lens.width
    camera = lens.camera.resized(*size)
    spread, scene = _CAUTION * np.sqrt(np.diag(found.adjusted.covariance)), found.adjusted.scene
    deviations = spread[:6] * (scale, scale, scale, scale, 1.0, 1.0)
    result = CameraFromMotion(
        camera=camera,
        deviations=dict(zip(NAMES, deviations.tolist(), strict=True)),
        rms=found.adjusted.rms * scale,
        frames=sum(len(piece.features) for piece in pieces),
        tracked=found.tracked,
        views=len(scene.cam_from_world),
        points=len(scene.xyz),
        observations=len(scene.view),
        fov=lens.fov,
        readout=scene.readout,
        readout_deviation=float(spread[6]),
    )
    refuse_unsure(result, name, settings)
    return result


@dataclass(frozen=True)
class LensFound:
    """An adjusted lens, and the frames that the odometry gave a pose with it."""

    adjusted: Adjusted
    tracked: int


def lens_of_pieces(
    pieces: list[Piece],
    width: int,
    height: int,
    settings: SelfCalibrationSettings,
    name: str = "the recording",
    told: Told = lambda stage, done, total: None,
) -> LensFound:
    """The lens under which the odometry over these features fits best.

    Args:
        pieces: features of raw pictures.
        width: of the pictures, pixels.
        height: pixels.
        settings: all numbers; how sure the lens is has to be judged by the caller.
        name: of the recording, for messages.
        told: is called with a stage in words, and how far it is.

    Raises:
        InputError: no map under any guess.
    """
    distance = settings.odometry.matching.max_distance
    pairs = far_pairs(pieces, width, settings.pairs, distance, settings.seed)
    if len(pairs) < _MIN_PAIRS:
        raise InputError(f"{name}: its camera cannot be found, since hardly two frames show the same; {_ADVICE}")
    tried = guesses(pairs, width, height, settings.model, settings.seed, lambda n, of: told("first guess", n, of))
    reason = "no map could be started"
    for guess in _different(tried)[: 1 + _FURTHER_GUESSES]:
        found = _from_guess(pieces, guess.lens, settings, told)
        if found is None:
            continue
        if agreement(pairs, found.adjusted.scene.lens, settings.seed) >= guess.score - _BETTER_GUESS:
            return found
        reason = "its maps contradict its pairs of frames"
    raise InputError(
        f"{name}: its motion does not tell its camera ({reason}: it hardly moves, or only turns); {_ADVICE}"
    )


_BETTER_THAN_A_GUESS = 0.1  # of the focal length; what one guesses of a phone's is 10 to 15 % off
_ADVICE = "walk sideways and turn past things near and far, or give --fov DEGREES or --camera FILE"


def _from_guess(pieces: list[Piece], lens: Lens, settings: SelfCalibrationSettings, told: Told) -> LensFound | None:
    """Odometry and adjustment in turns, from one guess; None where there is no map."""
    frames = sum(len(piece.features) for piece in pieces)
    found: LensFound | None = None
    for number in range(settings.rounds):
        done = 0

        def tracked(stage: str = f"odometry, round {number + 1}") -> None:
            nonlocal done
            done += 1
            told(stage, done, frames)

        try:
            maps = [track_piece(piece, lens, settings.odometry, tracked) for piece in pieces]
        except InputError:  # a distortion that cannot be undone
            return found
        now = _adjusted_lens(maps, lens, settings)
        if now is None:
            return found
        before, lens = lens, now.adjusted.scene.lens
        found = now
        if number > 0 and abs(lens.values[0] / before.values[0] - 1.0) < _SETTLED:
            break
    return found


def _adjusted_lens(maps: list[TrackedPiece], lens: Lens, settings: SelfCalibrationSettings) -> LensFound | None:
    tracked = sum(len(piece.views) for piece in maps)
    if tracked < _MIN_VIEWS:
        return None
    scene = scene_of(maps, lens, settings.views)
    if len(scene.cam_from_world) < _MIN_VIEWS or len(scene.xyz) < _MIN_POINTS:
        return None
    best = _fit(scene, lens)
    if settings.model == "auto" and lens.distorted:
        brown, fisheye = (best if lens.model == model else _fit(scene, lens.as_model(model)) for model in MODELS)
        best = fisheye if _cost_beside(fisheye, brown) < _SIMPLER * _cost_beside(brown, fisheye) else brown
    return LensFound(best.adjusted, tracked) if len(best.adjusted.scene.xyz) >= _MIN_POINTS else None


@dataclass(frozen=True)
class _Fit:
    """A scene adjusted with one model, and which of its observations (M,) took part."""

    adjusted: Adjusted
    kept: Mask


def _fit(scene: Scene, lens: Lens) -> _Fit:
    """A scene adjusted, its outliers left out, and adjusted again."""
    rough = adjust(replace(scene, lens=lens), _ROUGH)
    kept = rough.kept(rough.errors() > _OUTLIER)
    return _Fit(adjusted(rough.only(kept)), kept)


def _cost_beside(fit: _Fit, other: _Fit) -> float:
    """Cost of an observation, on average of those that one of the two fits kept.

    Those that only the other kept count as outliers: a model that is wrong at the rim leaves the rim out.
    """
    missing = int((other.kept & ~fit.kept).sum())
    return (fit.adjusted.cost + missing * outlier_cost(_OUTLIER)) / max(int((fit.kept | other.kept).sum()), 1)


def _different(tried: list[Guess]) -> list[Guess]:
    """Guesses, best first, each far from those before."""
    chosen: list[Guess] = []
    for guess in tried:
        focal = guess.lens.values[0]
        if all(abs(np.log(focal / other.lens.values[0])) > 0.25 for other in chosen):
            chosen.append(guess)
    return chosen


def refuse_unsure(result: CameraFromMotion, name: str, settings: SelfCalibrationSettings) -> None:
    """Raises: InputError, in plain words, where the numbers would mislead."""
    if not np.isfinite([result.fov, *result.values.values()]).all():
        raise InputError(
            f"{name}: its motion does not tell its camera (the distortion found has no inverse); {_ADVICE}"
        )
    if not result.focal_deviation <= settings.max_focal_deviation:  # nor where it is NaN
        found, advice = "no focal length fits better than another", _ADVICE
        if result.focal_deviation < 1:
            found = (
                f"{result.camera.fx:.0f} px +- {100 * result.focal_deviation:.1f} %, where "
                f"{100 * settings.max_focal_deviation:.2g} % is the limit (max_focal_deviation)"
            )
        if result.focal_deviation < _BETTER_THAN_A_GUESS:
            advice = f"--fov {result.fov:.0f} takes it all the same; or {_ADVICE}"
        raise InputError(f"{name}: its motion leaves the focal length open: {found}; {advice}")
    if not result.rms <= settings.max_rms:
        raise InputError(
            f"{name}: no camera explains it: points miss their places by {result.rms:.1f} px; its zoom or focus "
            f"changes, or its pictures are stabilised; {_ADVICE}"
        )
