"""Matches of descriptors, and tracks made of matches of consecutive frames (paper, "Point Tracks").

It imports no other room. Open `matching.py` first (mutual nearest neighbours), then `connect.py` (matches to tracks).
The loop that tracks the camera is in `odometry`.
"""
