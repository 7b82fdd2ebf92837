"""Class labels, sky and relative depth of photos, where the capture has no files of them."""

from climatenerf.perception.prepare import check_depth_model, prepare_depth, prepare_labels

__all__ = ["check_depth_model", "prepare_depth", "prepare_labels"]
