"""The paper's stability rule on tracks, and the tables that keep tracks and labels.

It imports `geometry`, `locations` and `untrusted`. Open `rule.py` first: `classify` is the equation. `tables.py` has
the columns of `points.parquet` and `tracks.parquet`.
"""
