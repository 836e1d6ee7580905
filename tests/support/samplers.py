"""Integrators of hybrid Monte Carlo, and what has to agree after a restart of one."""

import openmm

from openmm_sier import SIER2, SIERHMCIntegrator
from openmm_sier.engines import own_methods
from tests.support.restarts import everything
from tests.support.seeded import seeded

TEMPERATURE = 297.0
KT = 8.314462618e-3 * TEMPERATURE


def sampler(h=0.008, n=4, scheme=SIER2, seed=5, **options):
    return seeded(SIERHMCIntegrator(TEMPERATURE, h, scheme, stepsPerTrial=n, **options), seed)


def counted(context):
    """Everything that has to agree after a restart."""
    integrator = context.getIntegrator()
    return (*everything(context), integrator.trials, integrator.accepted, integrator.lastEnergyError)


def energies_computed(monkeypatch):
    """A list that grows with each State of a Context: whether its energy was computed."""
    computed, get = [], own_methods.get_state

    def counting(self, *args, **kwargs):
        computed.append(kwargs.get("energy", False))
        return get(self, *args, **kwargs)

    monkeypatch.setattr(openmm.Context, "getState", counting)
    monkeypatch.setattr(own_methods, "get_state", counting)
    return computed
