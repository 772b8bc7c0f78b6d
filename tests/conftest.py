"""Drawn tests draw the same each time, unless `make test-all` asks for others."""

from hypothesis import settings

settings.register_profile("fixed", derandomize=True)
settings.load_profile("fixed")
