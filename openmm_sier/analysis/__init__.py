"""Turns finished runs into numbers: means with errors, viscosity and diffusion, data for validation."""
