"""What an independent sample costs."""

from __future__ import annotations

import numpy as np
import pandas as pd

from openmm_sier.dynamics.statistics import inefficiency_and_error
from openmm_sier.measure.statistics import Estimate


def cost(samples: pd.DataFrame, forces: float) -> Estimate:
    """Forces for an independent sample; the mean over columns, which are components of one vector.

    Args:
        samples: a column for each component.
        forces: from one sample to the next.
    """
    found = np.array([inefficiency_and_error(samples[name].to_numpy()) for name in samples])
    return Estimate(forces * float(found[:, 0].mean()), forces * float(np.linalg.norm(found[:, 1])) / len(found))
