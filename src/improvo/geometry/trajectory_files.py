"""Trajectory files as the field has them: TUM, KITTI and EuRoC in, TUM and KITTI out. All hold camera-to-world.

A bad row (not numbers, NaN, no rigid motion) is named in the report. It becomes a row without a pose, or is left out
where it has no time either; KITTI's rows, which have none, all keep their places. A file without any pose is an error.
Rotations within 1e-2 of orthonormal are projected to SO(3): the pose files of 7-Scenes are
orthonormal only to about 3e-4, which would show as degrees of rotation error.
"""

from __future__ import annotations

import re
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.files import write_text
from improvo.geometry.se3 import quat_xyzw_from_rotation, rigid, rotation_from_quat_xyzw
from improvo.geometry.text_files import read_text
from improvo.geometry.time_units import in_seconds, note_of
from improvo.types import Float64, Int64, Trajectory
from improvo.untrusted.text import is_number

RIGID_TOLERANCE = 1e-2
NO_TIMES = "has no times; 10 poses per second assumed, as in KITTI"
_DECIMAL_COMMA = re.compile(r"[+-]?\d*(,\d+)?([eE][+-]?\d+)?")
_DATE = re.compile(r"\d{4}-\d\d-\d\d")
_TUM_HEADER = "# camera-to-world, {}: timestamp tx ty tz qx qy qz qw\n"
_OWN_HEADER = _TUM_HEADER.partition("{")[0]
_EUROC_NAMES = re.compile(r"^#?\s*timestamp\s*\[ns\]", re.IGNORECASE)
_SEGMENT_COMMENT = re.compile(r"#\s*segment\s+(\d+)\s*(?::|$)")


def read_trajectory(path: Path | str, format: str = "auto", times: Float64 | None = None) -> Trajectory:
    """The trajectory of a TUM, KITTI or EuRoC file; see `read_trajectory_report` for what was odd in it."""
    return read_trajectory_report(path, format, times)[0]


def read_trajectory_report(
    path: Path | str, format: str = "auto", times: Float64 | None = None, numbered: bool = False
) -> tuple[Trajectory, tuple[str, ...]]:
    """The trajectory of a TUM, KITTI or EuRoC file, and one line for each kind of problem in it.

    Args:
        path: the file.
        format: `tum`, `kitti`, `euroc`, or `auto` to tell by the columns.
        times: seconds, for KITTI's rows, which have none; without it `times.txt` beside the file, or 10 Hz.
        numbered: the first column of a TUM file is a number of frames: taken as it stands, whatever its size.

    Returns:
        The trajectory, sorted by time, bad rows NaN; and the problems.

    Raises:
        InputError: not such a file, or no row with a pose.
    """
    path = Path(path)
    lines = read_text(path, "a trajectory", "give a TUM, KITTI or EuRoC file").splitlines()
    format = _guess(lines, path) if format == "auto" else format
    columns = {"tum": 8, "kitti": 12, "euroc": 8}.get(format)
    if columns is None:
        raise InputError(f"{path}: unknown trajectory format {format!r}; known: tum, kitti, euroc")
    values, line_numbers, segment, malformed = _rows(lines, columns, all_count=format == "kitti")
    problems = _named("not numbers", malformed, "line")
    if len(values) == 0:
        raise InputError(f"{path}: has no row of {columns} numbers, so it is no {format.upper()} trajectory")
    if format == "kitti":
        matrices = np.concatenate([values.reshape(-1, 3, 4), np.tile([[[0.0, 0, 0, 1]]], (len(values), 1, 1))], axis=1)
        stamps, assumed = (np.asarray(times, np.float64), ()) if times is not None else _kitti_times(path, len(values))
        problems += assumed
        if len(stamps) < len(values):
            raise InputError(f"{path}: has {len(values)} poses but there are {len(stamps)} times; remove what is extra")
        stamps = stamps[: len(values)]
    else:
        stamps, unit = values[:, 0], None
        if format == "euroc":
            stamps = stamps * 1e-9
        elif not numbered and not lines[0].startswith(_OWN_HEADER):  # what we write is in seconds
            stamps, unit = in_seconds(stamps)
        problems += (note_of(unit),) if unit else ()
        w_first = (_quaternion_order(lines) or ("wxyz" if format == "euroc" else "xyzw")) == "wxyz"
        quat_xyzw = values[:, [5, 6, 7, 4]] if w_first else values[:, 4:8]
        matrices = _from_quaternions(quat_xyzw, values[:, 1:4])
    poses, not_finite, not_rigid = clean_poses(matrices)
    problems += _named("NaN or infinite", np.setdiff1d(line_numbers[not_finite], malformed), "line")
    problems += _named("not a rigid motion", line_numbers[not_rigid], "line")
    keep = np.isfinite(stamps)
    problems += _named("no time", line_numbers[~keep], "line")
    order, repeated = increasing_order(stamps[keep])
    problems += (f"{repeated} rows repeat a time stamp and were dropped",) if repeated else ()
    poses, stamps, segment = poses[keep][order], stamps[keep][order], segment[keep][order]
    has_pose = np.isfinite(poses).all(axis=(1, 2))
    if not has_pose.any():
        raise InputError(f"{path}: has no valid pose ({'; '.join(problems) or 'empty'}); remove or repair the file")
    trajectory = Trajectory(stamps, poses, np.where(has_pose, segment, -1).astype(np.int64))
    return trajectory, tuple(f"{path}: {problem}" for problem in problems)


def write_trajectory(path: Path | str, trajectory: Trajectory, format: str = "tum", unit: str = "up to scale") -> None:
    """Write a trajectory atomically; rows without a pose are left out of TUM files.

    A comment line `# segment N: ...` goes before each new segment; `read_trajectory` understands it, others skip it.
    KITTI files have neither times nor gaps: every row must have a pose. Nor do they tell one segment from another.

    Args:
        path: the file.
        trajectory: what to write.
        format: tum or kitti.
        unit: of lengths, for the first line of a TUM file.

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
        write_text(path, tum_text(trajectory, unit))
    else:
        raise InputError(f"{path}: unknown trajectory format {format!r}; known: tum, kitti")


def tum_text(trajectory: Trajectory, unit: str = "up to scale") -> str:
    """The trajectory as the text of a TUM file."""
    lines, segment = [_TUM_HEADER.format(unit.replace(":", ","))], None
    own = "world frame" if unit.startswith("metres") else "world frame and scale"
    for row in np.flatnonzero(trajectory.valid):
        if trajectory.segment[row] != segment:
            segment = trajectory.segment[row]
            lines.append(f"# segment {segment}: has its own {own}\n")
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


def _rows(lines: list[str], columns: int, all_count: bool = False) -> tuple[Float64, Int64, Int64, Int64]:
    """Rows of numbers, their line numbers (1-based) and segments; the line numbers of rows that are not.

    With `all_count`, those are among the rows too, as NaN: their number is a row's time.
    """
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
        fields = split_numbers(text)
        if not fields:
            continue
        try:
            row = [float(field) for field in fields[: max(columns, 1)]]
        except ValueError:
            row = []
        if len(row) < columns:
            if values or malformed or any(is_number(field) for field in fields):  # else the names of the columns
                malformed.append(number)
            if not (all_count and malformed and malformed[-1] == number):
                continue
            row = [float("nan")] * columns
        values.append(row)
        numbers.append(number)
        segments.append(segment)
    as_int = [np.asarray(column, np.int64) for column in (numbers, segments, malformed)]
    return np.asarray(values, np.float64).reshape(-1, columns), as_int[0], as_int[1], as_int[2]


def split_numbers(text: str) -> list[str]:
    """The fields of a row, separated by spaces, commas or semicolons; a decimal comma becomes a point.

    A comma is a decimal one where the fields are separated otherwise, and each has at most one between its digits.
    """
    parts = text.replace(";", " ").split()
    if len(parts) > 1 and any("," in part for part in parts) and all(_DECIMAL_COMMA.fullmatch(part) for part in parts):
        return [part.replace(",", ".") for part in parts]
    return text.replace(",", " ").replace(";", " ").split()


def _guess(lines: list[str], path: Path) -> str:
    named = False
    for line in lines:
        text = line.strip()
        fields = split_numbers(text)
        if not fields or text.startswith("#") or not is_number(fields[0]):
            named |= _EUROC_NAMES.search(text) is not None
            continue
        if len(fields) == 12:
            return "kitti"
        # EuRoC: nanoseconds (since 1970, or as the names of the columns say), commas, and columns after the quaternion
        nanoseconds = re.fullmatch(r"\d+" if named else r"\d{15,}", fields[0])
        if len(fields) >= 8 and "," in text and nanoseconds:
            return "euroc"
        if len(fields) == 8:
            return "tum"
        break
    raise InputError(f"{path}: is no trajectory; a row has 8 numbers (TUM, EuRoC) or 12 (KITTI)")


def _quaternion_order(lines: list[str]) -> str | None:
    """`wxyz` or `xyzw` as the names of the columns say it; None where they say nothing."""
    for line in lines:
        fields = [field for field in re.split(r"[\s,;#]+", line.lower()) if field and not field.startswith("[")]
        if fields and is_number(fields[0]):
            return None
        matches = [re.fullmatch(r"(?:q|quat|rot|orientation)\w*?([wxyz])(?:\[\])?", field) for field in fields]
        order = "".join(match.group(1) for match in matches if match is not None)
        if order in ("wxyz", "xyzw"):
            return order
    return None


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


def has_times(path: Path, beside: bool = True) -> bool:
    """Whether the rows of a trajectory file have times: KITTI's have none, unless a `times.txt` beside it fits.

    Args:
        path: of the file.
        beside: whether a `times.txt` counts.
    """
    lines = read_text(path, "a trajectory", "give a TUM, KITTI or EuRoC file").splitlines()
    if _guess(lines, path) != "kitti":
        return True
    return beside and not _kitti_times(path, len(_rows(lines, 12, all_count=True)[0]))[1]


def _kitti_times(path: Path, count: int) -> tuple[Float64, tuple[str, ...]]:
    """Times of KITTI poses: `times.txt` beside them if it fits, else 10 Hz, KITTI's rate, and a note."""
    beside = path.with_name("times.txt")
    if beside.is_file():
        times = read_times(beside)[0]
        if len(times) >= count:
            return times[:count], ()
    return np.arange(count) / 10.0, (NO_TIMES,)


def read_times(path: Path) -> tuple[Float64, tuple[str, ...]]:
    """Seconds, one a line, and a note where they were written in another unit.

    A line is a time, or `number time exposure` (DSO, TUM mono), or `time file`, or a date and a clock time (KITTI raw).

    Raises:
        InputError: a line that is none of these.
    """
    mend = "it must hold one time in seconds per line; repair or remove it"
    lines = read_text(path, "times", mend).splitlines()
    lines = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    rows = [split_numbers(line) for line in lines]
    if not all(rows):
        raise InputError(f"{path}: has a line of separators alone; {mend}")
    if all(re.fullmatch(r"\d+,\d+", line) for line in lines) and not _counts(rows):
        whole = [float(row[0]) for row in rows]
        if any(b <= a for a, b in pairwise(whole)):  # decimal commas: alone, the part before them does not increase
            rows = [[line.replace(",", ".")] for line in lines]
    if rows and not is_number(rows[0][0]) and not _DATE.match(rows[0][0]):
        rows = rows[1:]  # the names of the columns
    try:
        if rows and all(len(row) > 1 and _DATE.fullmatch(row[0]) for row in rows):
            stamps = np.array([_time_of_day(*row[:2]) for row in rows], np.float64)
        else:
            column = 1 if _counts(rows) else 0
            stamps = np.array([float(row[column]) for row in rows], np.float64)
    except (ValueError, IndexError, OverflowError) as error:
        raise InputError(f"{path}: must hold one time in seconds per line ({error}); repair or remove it") from None
    if not np.isfinite(stamps).all():
        raise InputError(f"{path}: holds a time that is not finite; repair or remove it")
    seconds, unit = in_seconds(stamps)
    return seconds, ((f"{path}: {note_of(unit)}",) if unit else ())


def _counts(rows: list[list[str]]) -> bool:
    """Whether the first column only numbers the rows, and the second has the times."""
    if len(rows) < 2 or not all(len(row) > 1 and row[0].isdecimal() and is_number(row[1]) for row in rows):
        return False
    numbers, second = (np.array([float(row[column]) for row in rows]) for column in (0, 1))
    return bool((np.diff(numbers) == 1).all() and (np.diff(second) > 0).all())


def _time_of_day(date: str, clock: str) -> float:
    """Seconds since 1970 of `2011-09-26 13:02:25.964389445`."""
    whole, _, fraction = clock.partition(".")
    return datetime.fromisoformat(f"{date}T{whole}+00:00").timestamp() + float(f"0.{fraction or 0}")


def _named(what: str, rows: Int64, unit: str) -> tuple[str, ...]:
    """One line that counts and names rows, none where there are none."""
    if len(rows) == 0:
        return ()
    shown = ", ".join(str(row) for row in rows[:5]) + (", ..." if len(rows) > 5 else "")
    return (f"{len(rows)} rows without a pose: {what} ({unit}{'s' if len(rows) > 1 else ''} {shown})",)
