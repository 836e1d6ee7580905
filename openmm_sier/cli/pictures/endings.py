"""Endings of the names of pictures."""

ENDINGS = (".png", ".svg", ".html")
