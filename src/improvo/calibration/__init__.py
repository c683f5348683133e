"""A camera model from a recording of a printed board.

It imports `geometry`. Open `from_board.py` first. Reading calibration files of other tools is not here but in
`geometry/camera_files`.
"""
