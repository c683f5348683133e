"""A trajectory against the truth: the errors over sub-trajectories of the paper's Table 2, and the absolute error."""
