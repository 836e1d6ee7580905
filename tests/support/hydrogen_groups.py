"""Bodies of a heavy atom with its hydrogens."""


def hydrogen_groups(topology):
    """The particles of each heavy atom with its hydrogens, but for water, by the bonds of a topology."""
    groups = {}
    for bond in topology.bonds():
        heavy, light = sorted(bond, key=lambda atom: atom.element.symbol == "H")
        if light.element.symbol == "H" and light.residue.name != "HOH":
            groups.setdefault(heavy.index, [heavy.index]).append(light.index)
    return list(groups.values())
