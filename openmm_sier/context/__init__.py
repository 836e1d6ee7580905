"""All that touches OpenMM: integrators, bodies of a System, checks, reporters."""
