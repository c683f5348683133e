"""What is learned from, as it is read: pictures, posed sequences, and labels of keypoints and tracks.

It imports `augmentation`, and `batches` imports it. Open `label_library.py` first: the labeled sequences of VO
adaptation, in bounded memory.

`label_library` opens a `labeled_frames` for each sequence, whose correspondences are of `landmarks`, kept on disk by
`landmark_files`; `wrong_links` tells tracks that jump from those that follow a thing that moves. `pictures` reads
folders and videos, `shapes` draws, `posed_sequence` has depth and poses. `point_labels` are keypoints of pictures,
`homographic_adaptation` finds them. `pack` is one file with all that a training reads.
"""
