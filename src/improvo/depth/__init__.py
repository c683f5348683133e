"""Dense depth maps of frames with known poses: plane sweep, agreement between frames, and a fused point cloud.

It imports `odometry`, `sequences`, `stability`, `geometry` and `untrusted`. Open `dense.py` first: what `improvo run
--dense` does. The compiled kernels load with the first depth map.
"""

from improvo.depth.depth_map import DepthMap
from improvo.depth.settings import DepthSettings, NeighbourSettings, SweepSettings

__all__ = ["DepthMap", "DepthSettings", "NeighbourSettings", "SweepSettings"]
