"""Give OpenMM users their integrators."""
