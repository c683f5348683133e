"""What a step learns from: drawn shapes, and pairs of views with what is known to be the same in both.

It imports `data` and `augmentation`. Open `homography_pairs.py` first, then `tracked_pairs.py`: the paper's Siamese
training.

Made by processes, with NumPy; batch by number, see `seeded`:
    `drawn_shapes`        single pictures whose corners are known (`improvo train shapes`)
    `homography_pairs`    two views of one picture (`improvo train homographies`)
    `tracked_pairs`       two frames of a labeled sequence that share tracks (`improvo train odometry`)

Made in torch where the network runs (`train_held`):
    `device_pairs`        two views of one picture, or two frames that poses and depth relate
    `pair_points`         which pixels of them show the same place; `alignment` moves these to where pictures agree
    `mixed_pairs`         `device_pairs` in turn with `tracked_pairs`
    `elsewhere`           pictures of other places beside another source of batches
    `picture_store`, `posed_frames`, `whole_frames`, `view_points`, `teacher`: what these are made of
"""
