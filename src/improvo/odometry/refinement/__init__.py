"""Observations of a map point moved to where the patch of its first picture lies. Open `keypoint_refinement` first."""
