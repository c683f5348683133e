"""3D-to-2D pose estimation, the paper's Table 1 and its figure of accuracy over thresholds.

`run` is the protocol from sequences to records, `protocol` one image pair, `results` the rows of `pose.json`, `tables`
their text. `self_truth` judges without ground truth, by one fixed run of the odometry.
"""
