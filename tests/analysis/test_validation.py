"""physical_validation's verdicts on our logs, whose distributions are known exactly: oscillators and an ideal gas."""

import numpy as np
import pytest

from openmm_sier.analysis.validation import ensemble_data, kinetic_data
from tests.support.canonical import DOF, ROWS, P, T, log

package = pytest.importorskip("physical_validation", reason="pip install openmm-sier[validation]")

pytestmark = pytest.mark.thorough

#: Standard errors. By chance, one number in 16000 lies so far out.
LIMIT = 4.0

OPTIONS = {"data_is_uncorrelated": True, "bootstrap_seed": 5, "verbosity": 0}


@pytest.mark.parametrize(
    ("wrong", "failing"),
    [
        ({}, set()),
        # As SIER2 with a step that is too long; 4 % are eight standard errors.
        ({"heated": (1.0, 0.96)}, {"rotation: mean"}),
        # The log's temperature is off by 6/192, six standard errors, though its kinetic energy is right.
        ({"counted": DOF - 6}, {"translation: mean"}),
        # As with a thermostat that scales velocities; a width is known to 1/sqrt(2*400) = 3.5 %.
        ({"narrowed": 0.7}, {"translation: width", "rotation: width"}),
    ],
)
def test_kinetic_energies_by_group(wrong, failing):
    results = {}
    for name, data in kinetic_data([log(**wrong)], T).items():
        # One in two is taken where chance makes neighbours look alike.
        assert len(data.observables.kinetic_energy) >= ROWS / 2
        mean, width = package.kinetic_energy.distribution(data, strict=False, **OPTIONS)
        results |= {f"{name}: mean": mean, f"{name}: width": width}
    assert len(results) == 4
    assert {name for name, distance in results.items() if distance > LIMIT} == failing


@pytest.mark.parametrize(
    ("one", "two", "said"),
    [
        # The best interval is 2 T/sqrt(dof/2) = 61 K; with volumes, whose work adds 65 to these 96, 47 K.
        ((T, None), (345.0, None), (380.0, None)),
        ((T, P), (345.0, P), (380.0, P)),
        ((T, P), (T, 1250.0), (T, 1500.0)),
    ],
)
def test_two_state_points(one, two, said):
    """The second at another state point than is said: the slope is 38 % too small then or more, and known to 6 %."""
    logs = log(pressure=P), log(two[0], two[1] or P, seed=2)
    first, right, wrong = (ensemble_data([logs[n]], *point) for n, point in ((0, one), (1, two), (1, said)))
    assert abs(package.ensemble.check(first, right, **OPTIONS)[0]) < LIMIT
    assert abs(package.ensemble.check(first, wrong, **OPTIONS)[0]) > LIMIT


def test_correlated_samples_of_all_logs_count_once():
    """Each sample five times over: g of this series is 5, so that one in five is taken."""
    repeated = {name: np.repeat(values, 5) for name, values in log(rows=200).items()}
    pooled = ensemble_data([repeated, repeated], T)
    assert 2 * 200 / 1.6 <= len(pooled.observables.potential_energy) <= 2 * 200 * 1.3
    kinetic = kinetic_data([repeated, repeated], T)
    assert len(kinetic["rotation"].observables.kinetic_energy) <= 2 * 200 * 1.3
    for data in kinetic.values():
        assert 3 * data.system.natoms - data.system.nconstraints == pytest.approx(DOF)


def test_a_log_too_short_for_its_degrees_of_freedom():
    with pytest.raises(ValueError, match="got 4"):
        kinetic_data([log(rows=4)], T)
