"""Depth images and surfaces: clouds of points, their fusion, and distances to a reference."""
