"""The pages that results are told on."""
