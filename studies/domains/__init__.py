"""Rigid domains beside elastic networks: coarse-grained proteins, C60, gas in a zeolite, and patchy particles."""
