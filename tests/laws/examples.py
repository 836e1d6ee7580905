"""Methods, mixtures and actions that every run of the laws tries."""

from tests.laws.actions import (
    ApplyConstraints,
    ApplyVelocityConstraints,
    DrawVelocities,
    HardenBonds,
    Load,
    Minimize,
    Reinitialize,
    Save,
    SetBoth,
    SetBox,
    SetParameter,
    SetPositions,
    SetVelocities,
    UpdateParameters,
)
from tests.laws.methods import method
from tests.laws.mixtures import Mixture
from tests.laws.molecules import Body, Chain, Jointed, Water, WithSite

#: Methods by which every setter is tried.
SIMPLE = [
    method("SIERIntegrator", stepSize=0.001),
    method("SIERLangevinIntegrator", temperature=300.0, frictionCoeff=3.0, stepSize=0.001),
    method("SIERLangevinIntegrator", temperature=300.0, frictionCoeff=3.0, rotationalFriction=3.0, stepSize=0.001),
    method("SIERHMCIntegrator", temperature=300.0, schemeStepSize=0.001, stepsPerTrial=2),
    method("SIERThermostatIntegrator", temperature=300.0, rate=5.0, every=1, stepSize=0.001),
]

#: Actions that change something.
EVERY_CHANGE = [
    DrawVelocities(300.0, 1),
    SetVelocities(1),
    ApplyVelocityConstraints(),
    SetPositions(0, 1, 1e-5),
    ApplyConstraints(),
    SetBoth(SetPositions(1, 2, 0.0), SetVelocities(2)),
    SetBox(1.02),
    SetParameter("pull", 3.0),
    SetParameter("hard", 1.2),
    UpdateParameters(0.2),
    Save("checkpoint"),
    Minimize(30),
    # Near the minimum the first step goes too far.
    Minimize(1),
    Load(0),
    Reinitialize(True),
    # Steps need more inner steps then, or are refused.
    HardenBonds(30.0),
]

#: Mixtures in which bodies are named or held by constraints, or there are none.
WITH_BODIES = {
    "free": Mixture((Water("flexible"), Chain(3)), 0, "PME"),
    "named": Mixture(
        (Body("bent"), WithSite(Water(), "out"), Chain(3, 1, "hydrogens")), 0, "cut-off", "custom", prepared="yes"
    ),
    "held": Mixture(
        (Body("bent", named=False), WithSite(Water(), "out"), Chain(3, 1, "hydrogens")), 0, "cut-off", prepared="yes"
    ),
    # Bodies alone hold together what bonds do not.
    "joining": Mixture((Jointed("bent", 1, "pair"), Jointed("line")), 0, "cut-off"),
}
