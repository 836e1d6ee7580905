"""Whether compiled kernels are there, and a System with bodies of all kinds."""

import importlib.util
from pathlib import Path

import numpy as np
import openmm

from openmm_sier import RigidBodies
from tests.support import opencl

#: Why tests are skipped without them.
MISSING = (
    "the package openmm-sier-kernels, built with the C headers of OpenCL, and OpenMM's OpenCL platform are not here: "
    "pip install ./kernels and 'openmm-sier[opencl-test]' bring them"
)


def are_here():
    """Return whether compiled kernels can be tested: they may be built for other platforms alone."""
    package = importlib.util.find_spec("openmm_sier_kernels")
    folders = () if package is None else package.submodule_search_locations or ()
    is_built = any(list(Path(folder).glob("*SIERKernelsOpenCL*")) for folder in folders)
    return is_built and "OpenCL" in opencl.gpu_platforms()


def shapes(random):
    """Coordinates of bodies, (k, 3) nm each, and the mass of their atoms: rings, lines, mirror images, large ones."""
    angles = np.arange(6) * np.pi / 3
    ring = 0.14 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    corner = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.11, 0], [0, 0, 0.13]])
    line = np.array([[0, 0, 0], [0.116, 0, 0], [-0.116, 0, 0]])
    large = 0.5 * random.normal(size=(150, 3))
    point = np.zeros((1, 3))
    return [
        *[(ring, 12.0)] * 3,
        *[(line[:2], 14.0)] * 2,
        (line, 14.0),
        *[(large, 3.0)] * 2,
        (corner, 5.0),
        (corner * [1, 1, -1], 5.0),
        *[(point, 20.0)] * 2,
    ]


def all_kinds():
    """System, positions (N, 3) in nm and bodies: those of `shapes`, a water with a virtual site, and a frozen atom."""
    random = np.random.default_rng(2)
    system = openmm.System()
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(3.0)
    system.setDefaultPeriodicBoxVectors([20, 0, 0], [0, 20, 0], [0, 0, 20])
    positions, rigid = [], []

    def add(coordinates, masses, centre):
        first = len(positions)
        for atom, mass in zip(coordinates, masses, strict=True):
            positions.append(centre + atom)
            system.addParticle(mass)
            force.addParticle(0.05 * (-1) ** len(positions), 0.3, 0.3)
        for i in range(first, len(positions)):
            for j in range(i):
                if j >= first:
                    force.addException(i, j, 0, 1, 0)
        return list(range(first, len(positions)))

    for number, (coordinates, mass) in enumerate(shapes(random)):
        turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
        centre = 2.7 * np.array([number % 4, number // 4, 0])
        atoms = add(coordinates @ (turn * np.linalg.det(turn)).T, [mass] * len(coordinates), centre)
        if len(atoms) > 1:
            rigid.append(atoms)
    water = np.array([[0, 0, 0], [0.09572, 0, 0], [-0.024, 0.0927, 0], [0.01, 0.01, 0]])
    oxygen, first, second, site = add(water, [16.0, 4.0, 4.0, 0.0], np.array([1.4, 1.4, 0.5]))
    x = np.array(positions)
    for i, j in ((oxygen, first), (oxygen, second), (first, second)):
        system.addConstraint(i, j, float(np.linalg.norm(x[i] - x[j])))
    system.setVirtualSite(site, openmm.ThreeParticleAverageSite(oxygen, first, second, 0.7, 0.15, 0.15))
    add(np.zeros((1, 3)), [0.0], np.array([4.1, 1.4, 0.5]))
    system.addForce(force)
    x = np.array(positions)
    return system, x, RigidBodies.from_system(system, None, rigid, x)
