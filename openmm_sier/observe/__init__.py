"""Observe a simulation: conservation, pressure, body states, reporters."""
