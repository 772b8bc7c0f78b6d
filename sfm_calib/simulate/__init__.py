"""Simulated scans with known truth: of images (a rendered room) and of feature tracks."""
