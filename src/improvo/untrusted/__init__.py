"""Safe reading of files from unknown sources: the sizes and shapes that a file declares are checked before it is read.

It imports no other room. Open `limits.py` first: all limits in one place. Each kind of file has one helper: `text` for
YAML and JSON, `numbers` for rows of numbers in them, `arrays` for NumPy's archives, `pictures` for image headers,
`decompression` for compressed parts, `paths` for file names.
"""
