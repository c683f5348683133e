"""Is a segment's path right, as far as its own evidence can tell?

`judging` collects the evidence while a segment runs, `evidence` measures how much the path depends on its parts,
`lens_evidence` what it says of the focal length, and `verdict` judges. `told_verdicts` reads verdicts from a run.json.
"""
