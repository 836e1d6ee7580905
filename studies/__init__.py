"""Experiments of the documentation, one command each. They are part of the repository, but not installed."""
