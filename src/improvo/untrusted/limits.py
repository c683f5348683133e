"""How large what we read may be. A file that says it holds more is refused before memory is taken for it."""

from __future__ import annotations

MAX_PIXELS = 1 << 28  # of a picture: 16,384 by 16,384
MAX_PICTURE_BYTES = 1 << 31  # of a picture, decoded
MAX_YAML_BYTES = 1 << 20  # of a YAML text; the largest calibrations known have a tenth
MAX_YAML_NODES = 200_000  # of a YAML text when its aliases are written out
MAX_JSON_BYTES = 1 << 26  # of a JSON text: an hour of Record3D's metadata at 60 frames a second
MAX_JSON_LISTS = 2_000_000  # lists and objects in a JSON text
MAX_JSON_VALUES = 8_000_000
MAX_TEXT_BYTES = 1 << 29  # of any other text: a trajectory of 200 Hz for a day has a quarter
MAX_ARRAY_BYTES = 1 << 29  # of one array in an archive
MAX_WEIGHTS_BYTES = 1 << 31  # of all tensors in a file; a network of ours has 5 MB
MAX_CHUNK_BYTES = 1 << 28  # of one compressed part of a bag; recorders write 1 to 4 MB
MAX_FILE_GROWTH = 200  # times its own size, of a file that is unpacked as a whole; pictures of noise-free rooms have 50
MIN_FILE_GROWTH = 1 << 26  # bytes that any such file may have
MAX_TABLE_BYTES = 1 << 33  # of the columns that are read of a table
MAX_MESSAGE = 120  # characters of a foreign error in our line
