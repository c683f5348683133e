"""Text as people's programs save it: with or without a byte-order mark, with line ends of any system."""

from __future__ import annotations

import codecs
from pathlib import Path

from improvo.errors import InputError
from improvo.untrusted.limits import MAX_TEXT_BYTES
from improvo.untrusted.paths import check_is_file, check_path

_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # before UTF-16, whose mark it begins with
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


def read_text(path: Path, what: str = "text", mend: str = "save it as UTF-8") -> str:
    """The content of a text file, line ends as \\n, no byte-order mark.

    Args:
        path: the file.
        what: what it should be, for the message.
        mend: how to mend it, for the message.

    Raises:
        InputError: it cannot be read, or is no text.
    """
    check_is_file(check_path(path))
    try:
        if path.stat().st_size > MAX_TEXT_BYTES:
            raise InputError(f"{path}: cannot be read as {what} (it is too large); {mend}")
        return decoded(path.read_bytes())
    except (OSError, ValueError, MemoryError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not a text file"
        raise InputError(f"{path}: cannot be read as {what} ({reason}); {mend}") from None


def decoded(data: bytes) -> str:
    """The text in these bytes: UTF-8, or as a byte-order mark says; line ends as \\n.

    Raises:
        UnicodeDecodeError: it is no text.
    """
    encoding = next((name for mark, name in _MARKS if data.startswith(mark)), "utf-8")
    text = data.decode(encoding)
    if "\0" in text:
        raise UnicodeDecodeError(encoding, data, 0, 1, "holds NUL characters")
    return text.replace("\r\n", "\n").replace("\r", "\n")
