"""Chooses the pictures among the files of a folder: masks, depth and the second stereo camera are often beside them."""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path

_OTHER = re.compile(
    r"depth|disp(arity)?|mask|segm?|semantic|label|instance|normals?|confidence|conf|flow|right|infra|thermal|albedo"
    r"|vignette|overlay|preview|thumb",
    re.IGNORECASE,
)
_LEFT = re.compile(r"(^|[^a-z])(left|l|rgb|color|colour|image|img|frame)([^a-z]|$)", re.IGNORECASE)
_LOSSY = (".jpg", ".jpeg", ".jpe", ".jfif")


def one_kind(folder: Path, files: list[Path]) -> tuple[list[Path], list[str]]:
    """The pictures of one camera among the files of a folder, and a note on those that were left out."""
    groups: dict[tuple[str, str], list[Path]] = defaultdict(list)
    for file in files:
        groups[(re.sub(r"\d+", "#", file.stem), file.suffix.lower())].append(file)
    if len(groups) < 2:
        return files, []
    others = {key for key in groups if _is_other(key[0])}
    pictures = [key for key in groups if key not in others]
    if not pictures:
        return files, []
    twins = _twins(groups, pictures)
    kept = set(pictures) - twins
    left_out = [key for key in groups if key not in kept]
    if not left_out:
        return files, []
    names = ", ".join(f"{stem}{suffix} ({len(groups[(stem, suffix)])})" for stem, suffix in sorted(left_out))
    what = ", ".join(f"{stem}{suffix}" for stem, suffix in sorted(kept))
    return (
        [file for file in files if (re.sub(r"\d+", "#", file.stem), file.suffix.lower()) in kept],
        [f"{folder}: only {what} are taken as pictures; left out: {names}. Other files want a folder of their own"],
    )


def _is_other(stem: str) -> bool:
    return any(_OTHER.fullmatch(word) for word in re.split(r"[^A-Za-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", stem)))


def _twins(groups: dict[tuple[str, str], list[Path]], pictures: list[tuple[str, str]]) -> set[tuple[str, str]]:
    """Groups that have the same numbers as another: the PNG beside a JPEG of the same name, the second of two eyes."""
    numbers = {key: sorted(tuple(re.findall(r"\d+", file.stem)) for file in groups[key]) for key in pictures}
    twins: set[tuple[str, str]] = set()
    for row, first in enumerate(pictures):
        for second in pictures[row + 1 :]:
            if numbers[first] != numbers[second] or len(numbers[first]) < 2 or not numbers[first][0]:
                continue
            if first[0] == second[0]:
                twins.add(second if first[1] in _LOSSY else first)
            elif _LEFT.search(first[0]) and not _LEFT.search(second[0]):
                twins.add(second)
            elif _LEFT.search(second[0]) and not _LEFT.search(first[0]):
                twins.add(first)
    return twins if twins != set(pictures) else set()
