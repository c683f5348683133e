"""What may differ between two views without anything having moved: a random homography, light and sensor.

It imports no other folder of `training`; `data` and `batches` import it. Open `views.py` first.

`views` draws one homography and carries points and pictures through it, `photometric` changes one picture, both in
NumPy and OpenCV. `views_batch` and `photometric_batch` do the same for a whole batch at once, the latter in torch.
"""
