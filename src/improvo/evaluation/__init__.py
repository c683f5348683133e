"""How good frontends, odometry and labels are: one folder for each protocol, and what the protocols share.

It imports `training`, `odometry`, `stability`, `sequences`, `frontend`, `tracking`, `geometry`, `jobs` and `untrusted`.
Open `pose/protocol.py` first (the paper's Table 1), then `trajectory/protocol.py` and `vo/protocol.py` (Table 2).
`truth` makes reference poses; `frontends` wraps other people's networks to compare with (ours are in
`improvo.frontend`).
"""
