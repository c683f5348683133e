"""Labels of many recordings: run the odometry, apply the stability rule, check the quality, store the result.

It imports `odometry`, `stability`, `sequences`, `frontend`, `geometry`, `jobs`, `locations` and `untrusted`. The rule
itself is in `stability/rule.py`. Open `labeler.py` first: labels of one recording. `quality` withholds doubtful labels,
`label_sequences` labels many recordings into a `store`, a `label_job` each, and `labeled` reads the store back.
"""
