"""Calibration targets: their description, their detection in images, and their printing."""
