"""How far trajectories of hybrid Monte Carlo miss their start when they are followed back.

    OPENMM_CPU_THREADS=1 python -m studies.checks.reversal

512 molecules of TIP3P, PME with a cut-off of 0.9 nm, momenta of 297 K, CPU platform, whose forces are in single
precision. A trajectory that misses by more than 1e-4 nm is refused; the message has the distance.
"""

from __future__ import annotations

from collections.abc import Sequence

import openmm

from openmm_sier import SIER2, SIER4G, SIERHMCIntegrator, prepare_system
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.inputs import forcefields
from openmm_sier.inputs.forcefields import Interactions
from studies.command import SYSTEMS

#: Schemes, steps in a trajectory, and the step in fs.
TRAJECTORIES: Sequence[tuple[Scheme, int, float]] = (
    (SIER4G, 10, 6.0),
    (SIER4G, 7, 9.0),
    (SIER2, 30, 2.0),
    (SIER4G, 100, 6.0),
)


def missed(scheme: Scheme, steps: int, step: float) -> str:
    """The distance in nm, or why the trajectory is refused."""
    box = forcefields.read_box(SYSTEMS / "tip3p-512.pdb", interactions=Interactions(0.9, 0.75, 5e-4))
    prepare_system(box.system)
    integrator = SIERHMCIntegrator(297, 1e-3 * step, scheme, steps)
    integrator.setRandomNumberSeed(1)
    context = openmm.Context(box.system, integrator, openmm.Platform.getPlatformByName("CPU"))
    context.setPositions(box.positions)
    try:
        integrator.step(1)
    except openmm.OpenMMException as refusal:
        return f"refused: {refusal}"
    return f"{integrator.reversalError:.1e} nm"


def main() -> None:
    for scheme, steps, step in TRAJECTORIES:
        print(f"{scheme.name}, {steps} steps of {step:g} fs: {missed(scheme, steps, step)}")


if __name__ == "__main__":
    main()
