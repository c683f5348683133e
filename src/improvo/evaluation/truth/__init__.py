"""Reference poses: reading them, putting them in the place of a recording's own truth, and making them.

`reference` reads the files, `referenced` opens a recording with them, and `structure_from_motion`, `metric_scale` and
`make` are `improvo truth`.
"""
