"""Reads the files that people have, and makes starts of them."""
