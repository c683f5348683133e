"""Why a video cannot be read, from its first bytes (no video, or an unsupported codec), and what to do."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

_HEAD = 4096  # bytes; every container has a NUL in them, no text has
_SCRIPTS = (b"ffconcat", b"#ext", b"v=0", b"<?xml", b"<asx", b"[playlist]", b"[reference]", b";ffmeta", b"#!")
_SEARCHED = 1 << 24  # bytes at the beginning and at the end of a file
_NAMES = {
    b"av01": "AV1",
    b"vp08": "VP8",
    b"vp09": "VP9",
    b"avc1": "H.264",
    b"avc3": "H.264",
    b"hvc1": "HEVC (H.265)",
    b"hev1": "HEVC (H.265)",
    b"vvc1": "VVC (H.266)",
    b"mp4v": "MPEG-4",
    b"jpeg": "Motion JPEG",
    b"apch": "ProRes",
    b"apcn": "ProRes",
    b"ap4h": "ProRes",
    b"CFHD": "CineForm",
    b"dvh1": "Dolby Vision",
    b"encv": "an encrypted codec",
    b"V_AV1": "AV1",
    b"V_VP8": "VP8",
    b"V_VP9": "VP9",
    b"V_MPEG4/ISO/AVC": "H.264",
    b"V_MPEGH/ISO/HEVC": "HEVC (H.265)",
}
_ENTRY = re.compile(rb"stsd.{12}(" + b"|".join(key for key in _NAMES if not key.startswith(b"V_")) + rb")", re.DOTALL)
_MATROSKA = re.compile(rb"V_[A-Z0-9]+(?:/[A-Z0-9]+)*")


def why_unreadable(path: Path) -> str:
    """Why a video cannot be opened, and what to do."""
    codec = video_codec(path)
    if codec is not None:
        return (
            f"its codec, {codec}, cannot be decoded here (or the file is cut short); convert it: ffmpeg -i "
            f"{shlex.quote(path.name)} -c:v libx264 -crf 16 converted.mp4"
        )
    if has_sound_alone(path):
        return "holds sound, and no pictures; give the video"
    if b"moov" not in _ends(path) and path.suffix.lower() in (".mp4", ".mov", ".m4v", ".3gp"):
        return "has no index, so the recording was cut off before its end; copy it again, or repair it"
    return "cannot be opened as a video (truncated, or a codec that is not known); copy it again or convert it"


def video_codec(path: Path) -> str | None:
    """The codec that an MP4 or Matroska file says its pictures have; None where it says none that is known."""
    data = _ends(path)
    match = _ENTRY.search(data)
    if match is not None:
        return _NAMES[match.group(1)]
    found = _MATROSKA.search(data) if data.startswith(b"\x1aE\xdf\xa3") else None
    return None if found is None else _NAMES.get(found.group(0), found.group(0).decode()[2:])


def has_sound_alone(path: Path) -> bool:
    """Whether a file is a recording of sound (WAV, MP3, FLAC, or an MP4 without a track of pictures)."""
    data = _ends(path)
    if data.startswith((b"ID3", b"fLaC", b"\xff\xfb")) or (data.startswith(b"RIFF") and data[8:12] == b"WAVE"):
        return True
    tracks = set(re.findall(rb"hdlr.{8}(soun|vide)", data, re.DOTALL))
    return tracks == {b"soun"}


def is_script(path: Path) -> bool:
    """Whether a file is a playlist or another text, which FFmpeg would follow to other files and addresses."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError:
        return False
    start = head.lstrip(b"\xef\xbb\xbf\xfe\xff\0 \t\r\n").lower()
    return b"\0" not in head or start.startswith(_SCRIPTS) or b"<mpd" in start


def _ends(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            data = file.read(_SEARCHED)
            size = path.stat().st_size
            if size > len(data):
                file.seek(max(len(data), size - _SEARCHED))
                data += file.read()
            return data
    except OSError:
        return b""
