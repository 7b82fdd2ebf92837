"""Class labels and relative depth of photos, for captures that have no files of them."""

from climatenerf.perception.prepare import check_depth_model, prepare_depth, prepare_labels

__all__ = ["check_depth_model", "prepare_depth", "prepare_labels"]
