"""How good frontends, odometry and labels are: a folder for each protocol, and what they share.

`settings` has every protocol's settings, `sources` the frames and features, `measures` what one image pair says,
`statistics` the curves and intervals, and `truth` the reference poses.
"""
