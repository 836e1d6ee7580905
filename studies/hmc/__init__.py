"""Hybrid Monte Carlo: cost of averages of a liquid."""
