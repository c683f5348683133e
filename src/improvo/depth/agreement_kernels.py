"""The compiled part of `improvo.depth.agreement`."""
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

import math

import numpy as np

from improvo.compiled import compiled


@compiled
def compare(
    depth, confidence, others, other_confidences, other_from_frame, intrinsics, tolerance, agreeing, contradicting, mean
):
    """Compare a depth map with those of other frames.

    Args:
        depth: (h, w) float32 of the frame, 0 where unknown.
        confidence: (h, w) float32.
        others: (N, h, w) float32 depths of the other frames.
        other_confidences: (N, h, w) float32.
        other_from_frame: (N, 4, 4).
        intrinsics: fx, fy, cx, cy of the maps.
        tolerance: relative difference up to which two depths agree.
        agreeing: (h, w) uint8, raised by each map with the same depth where the pixel's point falls.
        contradicting: (h, w) uint8, raised by each map that sees a farther surface through the point.
        mean: (h, w) float32, filled where there is a depth: the weighted mean of the inverse depths, as a depth.
    """
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    for y in range(height):
        for x in range(width):
            z = float(depth[y, x])
            if z <= 0.0:
                continue
            weights = float(confidence[y, x])
            total = weights / z
            px, py = (x - cx) / fx * z, (y - cy) / fy * z
            for n in range(len(others)):
                pose = other_from_frame[n]
                qz = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * z + pose[2, 3]
                if qz <= 0.0:
                    continue
                qx = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * z + pose[0, 3]
                qy = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * z + pose[1, 3]
                u, v = math.floor(fx * qx / qz + cx + 0.5), math.floor(fy * qy / qz + cy + 0.5)
                if u < 0 or u >= width or v < 0 or v >= height:
                    continue
                there = float(others[n, v, u])
                if there <= 0.0:
                    continue
                if abs(there - qz) > tolerance * qz:
                    if there > qz:
                        contradicting[y, x] += 1
                    continue
                agreeing[y, x] += 1
                # the point at the other map's depth on the same ray of the other frame, back in this frame
                scale = there / qz
                back = (
                    pose[0, 2] * (scale * qx - pose[0, 3])
                    + pose[1, 2] * (scale * qy - pose[1, 3])
                    + pose[2, 2] * (there - pose[2, 3])
                )
                if back > 0.0:
                    weight = float(other_confidences[n, v, u])
                    total += weight / back
                    weights += weight
            mean[y, x] = np.float32(weights / total)
