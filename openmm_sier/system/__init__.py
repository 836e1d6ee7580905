"""Reads an OpenMM System: bodies, constraints, masses, vibrations, checks."""
