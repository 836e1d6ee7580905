"""What OpenMM users call."""
