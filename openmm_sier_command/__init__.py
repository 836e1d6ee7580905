"""The arguments of the command `openmm-sier`.

A package of its own, since importing `openmm_sier` imports OpenMM: here `--help` and wrong arguments end at once.
"""
