"""Cameras, calibration files, rigid motions, trajectory files, two-view geometry and triangulation.

It imports `untrusted`. Open `camera.py` first, then `se3.py`. Everything is float64.
"""
