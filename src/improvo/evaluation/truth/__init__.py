"""Reference poses: reading them, putting them in the place of a recording's own truth, and making them.

`reference` reads the files (COLMAP's models by `geometry/colmap_model.py`), and `referenced` opens a recording with
them. `make` is `improvo truth`, of `structure_from_motion`, `metric_scale` and `motion_check`.
"""
