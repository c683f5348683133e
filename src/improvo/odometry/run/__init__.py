"""One recording from frames to files, and the files read back.

`run_odometry` writes the folder of a run, `run_folder` reads it. Each file of it has a module: `run_json`, `map_file`,
and `track_recorder` for the tracks and labels. `look_ahead` and `compile` only save time.
"""
