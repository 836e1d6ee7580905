"""The experiments of the documentation, one command each. They are in the repository, and not installed."""
