"""Integrators of hybrid Monte Carlo, and their counts, which a restart restores."""

import openmm

from openmm_sier import SIER2, SIERHMCIntegrator
from tests.support.restarts import everything
from tests.support.seeded import seeded

TEMPERATURE = 297.0
KT = 8.314462618e-3 * TEMPERATURE


def sampler(h=0.008, n=4, scheme=SIER2, seed=5, frictionCoeff=None, **options):
    return seeded(SIERHMCIntegrator(TEMPERATURE, h, scheme, n, frictionCoeff, **options), seed)


def counted(context):
    """Everything that has to agree after a restart."""
    integrator = context.getIntegrator()
    return (*everything(context), integrator.trials, integrator.accepted, integrator.lastEnergyError)


def states_asked(monkeypatch):
    """Return a list that grows with each State of a Context, by the kinds of data that it was asked for, a bit mask."""
    requests, get = [], openmm.openmm._openmm.Context_getState

    def counting(context, kinds, *args):
        requests.append(kinds)
        return get(context, kinds, *args)

    # Below all methods of Python, whoever has replaced them.
    monkeypatch.setattr(openmm.openmm._openmm, "Context_getState", counting)
    return requests
