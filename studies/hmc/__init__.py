"""Hybrid Monte Carlo: exactness, and cost of averages of a liquid."""
