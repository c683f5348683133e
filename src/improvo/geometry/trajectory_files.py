"""Trajectory files as the field has them: TUM, KITTI and EuRoC in, TUM and KITTI out. All hold camera-to-world.

A bad row (not numbers, NaN, no rigid motion) becomes a row without a pose and is named in the report; a file without
any pose is an error. Rotations within 1e-2 of orthonormal are projected to SO(3): the pose files of 7-Scenes are
orthonormal only to about 3e-4, which would show as degrees of rotation error.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.files import write_text
from improvo.geometry.se3 import quat_xyzw_from_rotation, rigid, rotation_from_quat_xyzw
from improvo.types import Float64, Int64, Trajectory

RIGID_TOLERANCE = 1e-2
_TUM_HEADER = "# camera-to-world, up to scale: timestamp tx ty tz qx qy qz qw\n"
_SEGMENT_COMMENT = re.compile(r"#\s*segment\s+(\d+)\s*(?::|$)")


def read_trajectory(path: Path | str, format: str = "auto", times: Float64 | None = None) -> Trajectory:
    """The trajectory of a TUM, KITTI or EuRoC file; see `read_trajectory_report` for what was odd in it."""
    return read_trajectory_report(path, format, times)[0]


def read_trajectory_report(
    path: Path | str, format: str = "auto", times: Float64 | None = None
) -> tuple[Trajectory, tuple[str, ...]]:
    """The trajectory of a TUM, KITTI or EuRoC file, and one line for each kind of problem in it.

    Args:
        path: the file.
        format: `tum`, `kitti`, `euroc`, or `auto` to tell by the columns.
        times: seconds, for KITTI's rows, which have none; without it `times.txt` beside the file, or 10 Hz.

    Returns:
        The trajectory, sorted by time, bad rows NaN; and the problems.

    Raises:
        InputError: not such a file, or no row with a pose.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise InputError(
            f"{path}: cannot be read as a trajectory ({reason}); give a TUM, KITTI or EuRoC file"
        ) from None
    format = _guess(lines, path) if format == "auto" else format
    columns = {"tum": 8, "kitti": 12, "euroc": 8}.get(format)
    if columns is None:
        raise InputError(f"{path}: unknown trajectory format {format!r}; known: tum, kitti, euroc")
    values, line_numbers, segment, malformed = _rows(lines, columns)
    problems = _named("not numbers", malformed, "line")
    if len(values) == 0:
        raise InputError(f"{path}: has no row of {columns} numbers, so it is no {format.upper()} trajectory")
    if format == "kitti":
        matrices = np.concatenate([values.reshape(-1, 3, 4), np.tile([[[0.0, 0, 0, 1]]], (len(values), 1, 1))], axis=1)
        stamps = _kitti_times(path, len(values)) if times is None else np.asarray(times, np.float64)
        if len(stamps) < len(values):
            raise InputError(f"{path}: has {len(values)} poses but there are {len(stamps)} times; remove what is extra")
        stamps = stamps[: len(values)]
    else:
        stamps = values[:, 0] * (1e-9 if format == "euroc" else 1.0)
        quat_xyzw = values[:, [5, 6, 7, 4]] if format == "euroc" else values[:, 4:8]
        matrices = _from_quaternions(quat_xyzw, values[:, 1:4])
    poses, not_finite, not_rigid = clean_poses(matrices)
    problems += _named("NaN or infinite", line_numbers[not_finite], "line")
    problems += _named("not a rigid motion", line_numbers[not_rigid], "line")
    keep = np.isfinite(stamps)
    order, repeated = increasing_order(stamps[keep])
    problems += (f"{repeated} rows repeat a time stamp and were dropped",) if repeated else ()
    poses, stamps, segment = poses[keep][order], stamps[keep][order], segment[keep][order]
    has_pose = np.isfinite(poses).all(axis=(1, 2))
    if not has_pose.any():
        raise InputError(f"{path}: has no valid pose ({'; '.join(problems) or 'empty'}); remove or repair the file")
    trajectory = Trajectory(stamps, poses, np.where(has_pose, segment, -1).astype(np.int64))
    return trajectory, tuple(f"{path}: {problem}" for problem in problems)


def write_trajectory(path: Path | str, trajectory: Trajectory, format: str = "tum") -> None:
    """Write a trajectory atomically; rows without a pose are left out of TUM files.

    A comment line `# segment N: ...` goes before each new segment; `read_trajectory` understands it, others skip it.
    KITTI files have neither times nor gaps: every row must have a pose.

    Raises:
        InputError: an unknown format, or a gap in a KITTI file.
        OutputError: the file cannot be written.
    """
    path = Path(path)
    if format == "kitti":
        if not trajectory.valid.all():
            raise InputError(f"{path}: a KITTI file cannot leave out poses; write a TUM file instead")
        rows = (" ".join(f"{value:.12g}" for value in pose[:3].ravel()) for pose in trajectory.world_from_cam)
        write_text(path, "".join(f"{row}\n" for row in rows))
    elif format == "tum":
        write_text(path, tum_text(trajectory))
    else:
        raise InputError(f"{path}: unknown trajectory format {format!r}; known: tum, kitti")


def tum_text(trajectory: Trajectory) -> str:
    """The trajectory as the text of a TUM file."""
    lines, segment = [_TUM_HEADER], None
    for row in np.flatnonzero(trajectory.valid):
        if trajectory.segment[row] != segment:
            segment = trajectory.segment[row]
            lines.append(f"# segment {segment}: has its own world frame and scale\n")
        lines.append(tum_row(float(trajectory.times[row]), trajectory.world_from_cam[row]))
    return "".join(lines)


def tum_row(time: float, world_from_cam: Float64) -> str:
    """One line of a TUM file: timestamp tx ty tz qx qy qz qw."""
    numbers = [*world_from_cam[:3, 3], *quat_xyzw_from_rotation(world_from_cam[:3, :3])]
    return f"{time:.9f} " + " ".join(f"{value:.12g}" for value in numbers) + "\n"


def clean_poses(matrices: Float64) -> tuple[Float64, Int64, Int64]:
    """Poses (N, 4, 4) with rotations projected to SO(3), and the rows that are not finite or not rigid (now NaN)."""
    poses = np.array(matrices, np.float64)
    finite = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    rotation = np.where(finite[:, None, None], poses[:, :3, :3], np.eye(3))
    # bounded first, so that huge numbers cannot overflow the product
    bounded = np.asarray(np.abs(rotation).max(axis=(1, 2), initial=0.0) < 2.0)
    rotation = np.where(bounded[:, None, None], rotation, 2.0 * np.eye(3))
    deviation = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max(axis=(1, 2), initial=0.0)
    last_row = np.abs(np.where(finite[:, None], poses[:, 3], [0, 0, 0, 1]) - [0, 0, 0, 1]).max(axis=1, initial=0.0)
    is_rigid = np.asarray(
        (deviation <= RIGID_TOLERANCE) & (np.linalg.det(rotation) > 0) & (last_row <= RIGID_TOLERANCE)
    )
    good = finite & is_rigid
    poses[~good] = np.nan
    poses[good] = rigid(_polished(poses[good, :3, :3]), poses[good, :3, 3])
    return poses, np.flatnonzero(~finite), np.flatnonzero(finite & ~is_rigid)


def _polished(rotation: Float64) -> Float64:
    """The rotations nearest to matrices within `RIGID_TOLERANCE` of one: Newton's iteration for the polar factor.

    The error squares in each step, so four reach rounding; twenty times faster than a singular value decomposition.
    """
    for _ in range(4):
        rotation = 1.5 * rotation - 0.5 * rotation @ np.swapaxes(rotation, 1, 2) @ rotation
    return rotation


def increasing_order(times: Float64) -> tuple[Int64, int]:
    """Rows in strictly increasing time (the first of repeated stamps), and how many repeat one."""
    order = np.argsort(times, kind="stable")
    first = np.diff(times[order], prepend=-np.inf) > 0
    return order[first], int((~first).sum())


def _rows(lines: list[str], columns: int) -> tuple[Float64, Int64, Int64, Int64]:
    """Rows of numbers, their line numbers (1-based) and segments; the line numbers of rows that are not."""
    values: list[list[float]] = []
    numbers: list[int] = []
    segments: list[int] = []
    malformed: list[int] = []
    segment = 0
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if text.startswith("#"):
            match = _SEGMENT_COMMENT.match(text)
            segment = int(match.group(1)[:9]) if match else segment
            continue
        fields = text.replace(",", " ").split()
        if not fields:
            continue
        try:
            row = [float(field) for field in fields[: max(columns, 1)]]
        except ValueError:
            row = []
        if len(row) < columns:
            malformed.append(number)
            continue
        values.append(row)
        numbers.append(number)
        segments.append(segment)
    as_int = [np.asarray(column, np.int64) for column in (numbers, segments, malformed)]
    return np.asarray(values, np.float64).reshape(-1, columns), as_int[0], as_int[1], as_int[2]


def _guess(lines: list[str], path: Path) -> str:
    for line in lines:
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        fields = text.replace(",", " ").split()
        if len(fields) == 12:
            return "kitti"
        # EuRoC: nanoseconds, commas, and further columns after the quaternion
        if len(fields) >= 8 and "," in text and re.fullmatch(r"\d{15,}", fields[0]):
            return "euroc"
        if len(fields) == 8:
            return "tum"
        break
    raise InputError(f"{path}: is no trajectory; a row has 8 numbers (TUM, EuRoC) or 12 (KITTI)")


def _from_quaternions(quat_xyzw: Float64, translation: Float64) -> Float64:
    """(N, 4, 4); a quaternion whose norm is off by more than the tolerance gives NaN or a scaled rotation."""
    norm = np.linalg.norm(np.where(np.isfinite(quat_xyzw), quat_xyzw, 0.0), axis=1)
    usable = np.isfinite(quat_xyzw).all(axis=1) & (norm > 1e-6) & (norm < 1e6)
    rotation = rotation_from_quat_xyzw(np.where(usable[:, None], quat_xyzw, [0.0, 0, 0, 1]))
    scaled = np.where(np.abs(norm - 1) <= RIGID_TOLERANCE, 1.0, 2.0)
    rotation = rotation * scaled[:, None, None]
    rotation[~np.isfinite(quat_xyzw).all(axis=1)] = np.nan
    rotation[np.isfinite(quat_xyzw).all(axis=1) & ~usable] = 0.0
    return rigid(rotation, translation)


def _kitti_times(path: Path, count: int) -> Float64:
    """Times of KITTI poses: `times.txt` beside them if it fits, else 10 Hz, KITTI's rate."""
    beside = path.with_name("times.txt")
    if beside.is_file():
        times = read_times(beside)
        if len(times) >= count:
            return times[:count]
    return np.arange(count) / 10.0


def read_times(path: Path) -> Float64:
    """Seconds, one a line.

    Raises:
        InputError: a line that is no number.
    """
    try:
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
        times = np.array([float(line.split()[0]) for line in lines if not line.lstrip().startswith("#")], np.float64)
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"{path}: must hold one time in seconds per line ({error}); repair or remove it") from None
    if not np.isfinite(times).all():
        raise InputError(f"{path}: holds a time that is not finite; repair or remove it")
    return times


def _named(what: str, rows: Int64, unit: str) -> tuple[str, ...]:
    """One line that counts and names rows, none where there are none."""
    if len(rows) == 0:
        return ()
    shown = ", ".join(str(row) for row in rows[:5]) + (", ..." if len(rows) > 5 else "")
    return (f"{len(rows)} rows without a pose: {what} ({unit}{'s' if len(rows) > 1 else ''} {shown})",)
