"""Visual odometry: the loop that tracks the camera, and the folder that a run leaves behind.

It imports `backend`, `stability`, `tracking`, `frontend`, `sequences`, `geometry`, `jobs` and `untrusted`. Open
`visual_odometry.py` first: the loop as a user calls it. Then `modes/robust.py`, the default mode, or `modes/paper.py`,
the paper's. Below the modes, each folder imports only from those named after it: `alarms/` is what ends a map,
`result/` what has been found, `verdict/` whether a segment is believed, `mapping/` the map around the camera,
`refinement/` more exact keypoints. Above the loop, `run/` makes files of a recording and reads them back, and `scale/`
brings them to metres.
"""
