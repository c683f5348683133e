"""Damage: a file's bytes with something changed, by a seed."""

from __future__ import annotations

import json
import random
import re
import struct
import zlib
from typing import Any

HUGE = "9" * 5000
WORDS = (
    *("nan", "inf", "-inf", "1e999", "-1", "0", "1e-400", HUGE, "18446744073709551616", "2001-99-99", "null", "[]"),
    *("{}", "true", "~", "''", "[[[[[[[[1]]]]]]]]", "1²3", "\N{ARABIC-INDIC DIGIT TWO}", "\ud800", "\0", "../../x"),
    *("&a [*a]", "!!python/object:os.system x", "x" * 300, "NaN", "Infinity", "0x10", "1_0", "1:30:00", "é", ",", ""),
)
VALUES: tuple[Any, ...] = (
    *(None, True, -1, 0, 1, 2**31, 2**63, 2**64, 1e308, float("nan"), float("inf"), "", "x", "\ud800", "../x", "a\0b"),
    *([], {}, [[]], {"": None}, "x" * 300, [1, "2"], 0.5),
)
INTEGERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x40000000)
_WORD = re.compile(rb"[^\s,:;\[\]{}=\"'<>]+")


def mutated(data: bytes, chance: random.Random, text: bool) -> bytes:
    """The bytes with one to eight changes."""
    if text and chance.random() < 0.4 and (changed := _changed_json(data, chance)) is not None:
        return changed
    for _ in range(chance.choice((1, 1, 1, 2, 4, 8))):
        data = _words_exchanged(data, chance) if text and chance.random() < 0.7 else _damaged(data, chance)
    return _with_checksums(data) if data.startswith(b"\x89PNG") and chance.random() < 0.7 else data


def _damaged(data: bytes, chance: random.Random) -> bytes:
    if not data:
        return chance.randbytes(chance.randrange(40))
    # half of the damage goes where the headers are, at one end or the other
    reach = chance.choice((len(data), len(data), min(len(data), 64), min(len(data), 600)))
    place = chance.randrange(reach)
    if chance.random() < 0.2:
        place = len(data) - 1 - place
    kind = chance.randrange(7)
    if kind == 0:
        return data[:place] + bytes([data[place] ^ (1 << chance.randrange(8))]) + data[place + 1 :]
    if kind == 1:
        return data[:place] + chance.randbytes(1) + data[place + 1 :]
    if kind == 2:
        layout = chance.choice(("<H", ">H", "<I", ">I", "<Q", ">Q"))
        number = chance.choice(INTEGERS) & (256 ** struct.calcsize(layout) - 1)
        return data[:place] + struct.pack(layout, number) + data[place + struct.calcsize(layout) :]
    if kind == 3:
        return data[:place]
    if kind == 4:
        return data[:place] + data[place + chance.randrange(1, 64) :]
    if kind == 5:
        end = place + chance.randrange(1, 64)
        return data[:end] + data[place:end] * chance.choice((1, 2, 50)) + data[end:]
    return data[:place] + chance.randbytes(chance.randrange(1, 16)) + data[place:]


def _words_exchanged(data: bytes, chance: random.Random) -> bytes:
    """A word of a text exchanged for one of those that programs trip over, or a line doubled or left out."""
    if chance.random() < 0.2:
        lines = data.split(b"\n")
        row = chance.randrange(len(lines))
        lines[row : row + 1] = [lines[row]] * chance.choice((0, 2, 3))
        return b"\n".join(lines)
    places = list(_WORD.finditer(data))
    if not places:
        return data + b"x"
    place = chance.choice(places)
    word = chance.choice(WORDS).encode("utf-8", "surrogatepass")
    return data[: place.start()] + word + data[place.end() :]


def _changed_json(data: bytes, chance: random.Random) -> bytes | None:
    """JSON with a value exchanged, dropped or renamed; None where it is no JSON."""
    try:
        root = json.loads(data)
    except (ValueError, RecursionError):
        return None
    holders: list[Any] = []

    def collect(node: Any) -> None:
        if isinstance(node, dict | list) and node:
            holders.append(node)
            for child in node.values() if isinstance(node, dict) else node[:50]:
                collect(child)

    collect(root)
    if not holders:
        return json.dumps(chance.choice(VALUES)).encode()
    holder = chance.choice(holders)
    key = chance.choice(list(holder)) if isinstance(holder, dict) else chance.randrange(len(holder))
    kind = chance.random()
    if kind < 0.15:
        del holder[key]
    elif kind < 0.25 and isinstance(holder, dict):
        holder["new"] = holder.pop(key)
    elif kind < 0.3:
        return json.dumps(chance.choice(VALUES)).encode()
    else:
        holder[key] = chance.choice(VALUES)
    return json.dumps(root).encode()


def _with_checksums(data: bytes) -> bytes:
    """A PNG with the checksums that its chunks should have, so that a decoder goes on to what was damaged."""
    parts, place = [data[:8]], 8
    while place + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, place)
        if place + 12 + length > len(data):
            break
        content = data[place + 4 : place + 8 + length]
        parts += [data[place : place + 4], content, struct.pack(">I", zlib.crc32(content))]
        place += 12 + length
    return b"".join(parts) + data[place:]
