"""Judges steps and runs: vibrations and librations that a step is too long for, and runs that have become too hot."""
