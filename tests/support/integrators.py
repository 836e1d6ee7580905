"""OpenMM's integrators for comparisons."""

import openmm


def constrained_velocity_verlet(h):
    """The peer that starts from the same phase point: RATTLE as a CustomIntegrator (OpenMM's documentation)."""
    verlet = openmm.CustomIntegrator(h)
    verlet.addPerDofVariable("x1", 0)
    verlet.addUpdateContextState()
    verlet.addComputePerDof("v", "v+0.5*dt*f/m")
    verlet.addComputePerDof("x", "x+dt*v")
    verlet.addComputePerDof("x1", "x")
    verlet.addConstrainPositions()
    verlet.addComputePerDof("v", "v+0.5*dt*f/m+(x-x1)/dt")
    verlet.addConstrainVelocities()
    verlet.setConstraintTolerance(1e-10)
    return verlet
