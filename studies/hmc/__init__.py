"""Hybrid Monte Carlo: whether it is exact, and what averages of a liquid cost with it."""
