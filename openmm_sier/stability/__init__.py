"""Judges steps and runs: vibrations and spins that a step is too long for, and runs that have become too hot."""
