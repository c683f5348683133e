"""Files of strangers: what they say of their own size and shape is checked before it is believed.

The limits are in `limits`, all in one place. Each kind has one helper: `text` for YAML and JSON, `arrays` for NumPy's
archives, `pictures` for the sizes that encoded images name, `decompression` for compressed parts, `paths` for names.
"""
