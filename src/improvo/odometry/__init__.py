"""Visual odometry: the loop that tracks the camera, and the folder that a run leaves behind.

It imports `backend`, `stability`, `tracking`, `frontend`, `sequences`, `geometry`, `jobs` and `untrusted`. Open
`visual_odometry.py` first: the loop as a user calls it. Then `robust.py`, the default mode, or `paper.py`, the paper's.
`mapping/` is the map around the camera, `alarms/` what ends it, `verdict/` whether a segment is believed, `refinement/`
more exact keypoints, `scale/` metres.
"""
