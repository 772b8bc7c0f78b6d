"""Scenes that tests make for themselves."""
