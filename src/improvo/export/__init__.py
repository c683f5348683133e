"""Finished runs and networks as files of other tools: COLMAP, Nerfstudio, trajectories, ONNX.

It imports `odometry` (to read a run folder), `evaluation` (for COLMAP's library), `frontend` (for ONNX), `tracking`,
`sequences` and `geometry`. Open `model.py` first: the part of a run that COLMAP and Nerfstudio receive. A new exporter
is a function here, two functions in `cli/export.py` (arguments, and the call), and a line in `cli/commands.py`.
"""
