"""Cameras, rigid motions, alignment: pure NumPy, float64."""
