"""The map around the camera: how it starts, grows, is adjusted, and is joined with a former one.

`start` makes a map from two views, `local_map` localises views in it and adds points, `sliding_window` says what
`bundle_adjustment` adjusts, `bridging` joins it with that of a segment that was lost.
"""
