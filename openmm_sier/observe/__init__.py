"""What is observed of a simulation: conservation, pressure, body states, reporters."""
