"""How many metres a unit of a run is.

`settings` says from what it is known, `sources` estimates it, one file for each source, `apply` brings a run's outputs
to metres.
"""
