"""Everything that uses OpenMM: integrators, bodies of a System, checks, reporters."""
