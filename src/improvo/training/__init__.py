"""Training of the network: drawn shapes, homographic adaptation, and adaptation to labels of visual odometry.

It imports `labeling`, `stability`, `sequences`, `frontend`, `geometry`, `jobs`, `locations` and `untrusted`. Open
`stages.py` first: one function for each `improvo train` command. Then `losses.py` and `vo_adaptation.py`, which is the
paper's training.
"""
