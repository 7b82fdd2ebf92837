"""Class labels, sky and relative depth of photos, where the capture has no files of them."""

from climatenerf.perception.prepare import prepare_depth, prepare_labels

__all__ = ["prepare_depth", "prepare_labels"]
