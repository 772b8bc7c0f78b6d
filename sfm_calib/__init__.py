"""Recalibrate cameras and rigs from ordinary scans, with sigmas that hold."""

__version__ = "0.1.0"
