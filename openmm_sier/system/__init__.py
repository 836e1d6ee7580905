"""Reads an OpenMM System: bodies, constraints, masses, temperatures, checks."""
