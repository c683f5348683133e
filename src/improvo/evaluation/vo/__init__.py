"""Visual odometry with and without stability weights, the rows of the paper's Table 2."""
