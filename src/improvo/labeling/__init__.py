"""Stability labels of tracks (paper, "Labeling Stability") and the tables and folders that keep them."""
