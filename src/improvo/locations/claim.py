"""A lock file at a location: machines that share nothing else see who works on what.

The holder writes the file anew every few seconds; one whose file does not change any more is dead. Where the location
can create a file only if it is not there (S3, Google Cloud Storage), two that begin at once cannot both have it; else
the last one to write has it.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from improvo.locations.place import LocationReadError, LocationWriteError, Place

BEAT_SECONDS = 15.0  # a request for each sequence in work
_PATIENCE_BEATS = 5.0  # without a beat, after which the holder is dead
_LOOK_SECONDS = 1.0
_SETTLE_SECONDS = 1.0
_LAST_BEAT_SECONDS = 30.0
IsDead = Callable[[dict[str, Any]], bool]


class ClaimedError(Exception):
    """Somebody else has it.

    Args:
        holder: what the file says of them; empty where it cannot be read.
    """

    def __init__(self, holder: dict[str, Any]) -> None:
        super().__init__(str(holder))
        self.holder = holder


class Claim:
    """Held from its making to `release`.

    Args:
        place: the location.
        path: the local file that stands for that of the lock.
        mine: who holds it; with a `token` of its own.
        is_dead: whether a holder is known to have ended, so that nobody need wait for a beat.

    Raises:
        ClaimedError: somebody else has it.
        LocationReadError, LocationWriteError: the location does not answer.
    """

    def __init__(self, place: Place, path: Path, mine: dict[str, Any], is_dead: IsDead) -> None:
        self._place, self._path, self._target = place, path, place.remote(path)
        self._mine = mine
        if not self._created():
            holder = read_claim(place, path)
            if holder is not None and not is_dead(holder) and (_is_fresh(holder) or self._is_renewed(holder)):
                raise ClaimedError(holder)
            self._take()
            time.sleep(_SETTLE_SECONDS)
            now = read_claim(place, path) or {}
            if now.get("token") != mine["token"]:
                raise ClaimedError(now)
        self._released = threading.Event()
        self._beats = threading.Thread(target=self._beat, daemon=True, name="claim")
        self._beats.start()

    def release(self) -> None:
        """Let go, if nobody has taken it for dead meanwhile."""
        self._released.set()
        self._beats.join(_LAST_BEAT_SECONDS)  # one that is on its way would make the file anew
        with suppress(Exception):
            if (read_claim(self._place, self._path) or {}).get("token") == self._mine["token"]:
                self._place.fs.rm_file(self._target)

    def _content(self) -> bytes:
        return json.dumps({**self._mine, "beat": time.time()}).encode()

    def _created(self) -> bool:
        """Whether nobody had it, and this process has it now."""
        fs = self._place.fs

        def create() -> bool:
            with suppress(OSError, NotImplementedError):  # object stores have no folders
                fs.makedirs(self._target.rpartition("/")[0], exist_ok=True)
            try:
                fs.pipe_file(self._target, self._content(), mode="create")
            except FileExistsError:
                return False
            except (TypeError, ValueError, NotImplementedError):  # a file system that cannot
                return False
            return True

        return self._place.tries(create, "written", LocationWriteError)

    def _take(self) -> None:
        self._place.tries(self._write, "written", LocationWriteError)

    def _write(self) -> None:
        self._place.fs.pipe_file(self._target, self._content())

    def _is_renewed(self, holder: dict[str, Any]) -> bool:
        """Whether the holder writes the file anew while it is watched; the clocks of two machines may differ."""
        ends = time.monotonic() + _PATIENCE_BEATS * BEAT_SECONDS
        while time.monotonic() < ends:
            time.sleep(_LOOK_SECONDS)
            if (now := read_claim(self._place, self._path)) != holder:
                return now is not None
        return False

    def _beat(self) -> None:
        while not self._released.wait(BEAT_SECONDS):
            with suppress(Exception):  # a location that is away for a while
                holder = _holder_at(self._place, self._target)
                if holder is not None and holder.get("token") != self._mine["token"]:
                    return  # this process slept for so long that it was taken for dead
                self._write()


def _is_fresh(holder: dict[str, Any]) -> bool:
    """Whether the last beat was just now, by the clock of this machine."""
    beat = holder.get("beat")
    return isinstance(beat, int | float) and abs(time.time() - beat) < 2 * BEAT_SECONDS


def read_claim(place: Place, path: Path) -> dict[str, Any] | None:
    """Who holds it; None if nobody does.

    Raises:
        LocationReadError: the location does not answer.
    """
    target = place.remote(path)
    return place.tries(lambda: _holder_at(place, target), "read", LocationReadError)


def _holder_at(place: Place, target: str) -> dict[str, Any] | None:
    """As `read_claim`, with one try."""
    place.fs.invalidate_cache()
    try:
        content: bytes = place.fs.cat_file(target)
    except FileNotFoundError:
        return None
    return holder_in(content)


def holder_in(content: bytes) -> dict[str, Any]:
    """What a lock file says of its holder; empty where it says nothing that can be read."""
    try:
        found = json.loads(content)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}
