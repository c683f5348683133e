"""Dense depth of frames from known poses: plane sweep, agreement between frames, and a fused point cloud.

Light to import; the compiled kernels load with the first depth map.
"""

from improvo.depth.depth_map import DepthMap
from improvo.depth.settings import DepthSettings, NeighbourSettings, SweepSettings

__all__ = ["DepthMap", "DepthSettings", "NeighbourSettings", "SweepSettings"]
