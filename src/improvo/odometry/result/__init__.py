"""What the odometry has found and nothing changes any more.

`odometry_result` takes over each view when its pose is final, and each segment when it ends; it builds the trajectory
(`trajectory_builder`) and the map (`map_builder`) of all segments. `events` is what the user should know of frames.
"""
