"""Everything a person looks at: pictures, HTML pages, the live viewer.

It imports `evaluation`, `labeling`, `odometry`, `stability`, `tracking`, `frontend`, `geometry` and `untrusted`. Open
`pages.py` first: which page fits an output folder. `run_page.py` is the page of a run; `*_picture.py` are the pictures.
"""
