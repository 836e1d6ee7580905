"""Exchanges the program of an integrator, which is written before its System is known."""

from __future__ import annotations

import inspect
from xml.etree import ElementTree

import openmm

from openmm_sier.engines.native.installation import install
from openmm_sier.engines.native.program import Program


def rewrite(integrator: openmm.CustomIntegrator, program: Program | None) -> None:
    """Give an integrator another program. Its variables, functions, seed, tolerance and force groups stay.

    OpenMM cannot take a computation back. So the Python object gets another OpenMM object, from the XML of its present
    one with other computations. This is possible until a Context is created, which holds the OpenMM object.

    Args:
        integrator: in no Context, and with the variables that `install` adds.
        program: None for an integrator that only the exact engine can execute.
    """
    donor = openmm.CustomIntegrator(1.0)
    install(program, donor)
    root, other = (ElementTree.fromstring(openmm.XmlSerializer.serialize(one)) for one in (integrator, donor))
    computations = [child.tag for child in root].index("Computations")
    root[computations] = other[[child.tag for child in other].index("Computations")]
    # Unwrapped, it makes a plain CustomIntegrator and not one of ours.
    plain = inspect.unwrap(openmm.XmlSerializer._deserializeIntegrator)
    integrator.this = plain(ElementTree.tostring(root, encoding="unicode")).this
