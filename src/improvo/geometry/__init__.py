"""Cameras, calibration files, rigid motions, trajectory files, epipolar geometry, triangulation, and poses from
matches with outliers (`ransac.py`, the one place that talks to PoseLib).

It imports `untrusted`. Open `camera.py` first, then `se3.py`. Everything is float64.
"""
