"""Training of the network: drawn shapes, homographic adaptation, and adaptation to labels of visual odometry.

It imports `labeling`, `stability`, `sequences`, `frontend`, `geometry`, `jobs`, `locations` and `untrusted`. Open
`odometry_training.py` first: the paper's training. Then `stages/vo_adaptation.py` and `stages/losses.py`: what it
minimises.

The trainings as verbs, from what they learn from to a folder with weights:
    `superpoint_training`   `improvo train shapes`, `improvo train homographies`
    `odometry_training`     `improvo train odometry`, the paper's VO adaptation
    `held_training`         weights trained on, their detector held; `improvo improve` trains by it
    `metric_training`       the descriptor metric in closed form, without gradients

What they are made of, a folder each:
    `data/`                 what is learned from, as it is read: pictures, posed sequences, labels, landmarks, packs
    `augmentation/`         what may differ between two views: random homographies, light and sensor
    `batches/`              what a step learns from: drawn shapes, and pairs of views of each kind
    `stages/`               what a step minimises: the losses, and the network with its losses in each stage

What they share:
    `settings`, `held_settings`, `setting_checks`              all numbers; importable without torch
    `trainer`, `metrics`, `output_folder`                      the loop, its rows of figures, its output folder
    `device`, `distributed`, `shared_statistics`               one device; several processes under `torchrun`
    `networks`, `widen`, `interpolated_weights`                the network at the start; weights part of the way
"""
