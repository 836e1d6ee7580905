"""What executes the formulas: NumPy, or loops compiled by Numba."""
