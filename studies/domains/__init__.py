"""Rigid domains and elastic networks: coarse-grained proteins, gas in a zeolite, and patchy particles."""
