"""Rigid-body dynamics with NumPy, without OpenMM."""
