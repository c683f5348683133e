"""Frontends to compare with that are no part of the package: peers, and features exported by other programs."""
