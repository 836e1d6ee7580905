"""Rigid domains and elastic networks: coarse-grained proteins, C60, gas in a zeolite, and patchy particles."""
