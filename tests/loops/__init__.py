"""Tests at random moments, as long as one likes: commands, `python -m tests.loops.NAME`, that a test runs for short."""
