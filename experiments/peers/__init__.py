"""Calibration from a target beside its peers, on the same corners: ours, OpenCV's, mrcal's."""
