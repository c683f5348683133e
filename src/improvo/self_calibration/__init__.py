"""A camera from the video itself: the odometry runs with a guess, and the camera is adjusted with its views and points.

It imports `odometry`, `sequences`, `frontend`, `tracking`, `geometry` and `untrusted`. Open `from_motion.py` first.
"""
