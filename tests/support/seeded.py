"""Seeds that make random numbers reproducible."""


def seeded(made, seed=3):
    """An integrator or a Force of OpenMM, given its seed."""
    made.setRandomNumberSeed(seed)
    return made
