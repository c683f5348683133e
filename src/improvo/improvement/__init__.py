"""The self-improvement loop: rounds of labelling and training, each validated on video that training never sees.

It imports `report`, `evaluation`, `training`, `labeling`, `depth`, `odometry`, `stability`, `sequences`, `frontend`,
`geometry`, `jobs`, `locations` and `untrusted`. Open `improve.py` first: the loop. `rounds` has the steps of a round,
`split` says what is trained on and what is held back, `validation` measures a frontend and decides which of two is
better.
"""
