"""What a step minimises: the losses, and for each stage the network with its losses on a batch.

It imports `data` and `augmentation`. Open `losses.py` first, then `vo_adaptation.py`: the paper's three heads together.

`base` is what a stage is, `superpoint` SuperPoint's two, `vo_adaptation` the paper's, `held` descriptors alone while
the other heads are held. `descriptor_metric` learns without steps: a linear map of descriptors in closed form.
"""
