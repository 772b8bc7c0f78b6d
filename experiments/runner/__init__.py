"""Studies from config files: their trials, where these run, and the answer they give together."""
