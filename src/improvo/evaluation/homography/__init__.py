"""Repeatability and homography accuracy on image pairs, the tables of SuperPoint (DeTone et al. 2018)."""
