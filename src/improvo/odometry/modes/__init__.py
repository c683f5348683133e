"""The two modes of the odometry, and the states that they go through.

`mapper` is what they have in common: a mapper gives each view a pose. `robust` is the default, `paper` the paper's own
scheme. `states` draws every way from one state to another.
"""
