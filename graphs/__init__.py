"""The maths of sfm_calib: lenses, transforms, the factor graph and its uncertainty.

Imports numpy, scipy, numba and gtsam only; files, images and COLMAP live in `sfm_calib`.
"""
