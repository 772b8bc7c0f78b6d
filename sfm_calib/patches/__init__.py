"""Least-squares matching: patches of a track aligned to each other, to hundredths of a pixel."""
