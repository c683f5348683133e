"""Labels of many sequences: the labeller of one, the quality gate, the store, and the jobs that fill it.

`labeler` makes labels of a recording, `quality` withholds those that are not to be trusted, `label_sequences` does it
for many recordings into a `store`, `labeled` reads the store back, with the `frames` behind the labels.
"""
