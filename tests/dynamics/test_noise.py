"""Random numbers are those of NumPy's Philox for a key and a counter, whatever was drawn before."""

import numpy as np
import pytest

from openmm_sier.dynamics.noise import generator


@pytest.mark.parametrize(("seed", "draw", "stream"), [(0, 0, 0), (1, 5, 2), (2**31 - 1, 2**40, 4), (2**100 + 7, 3, 1)])
def test_numbers_are_those_of_a_fresh_generator(seed, draw, stream):
    expected = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, draw, stream]))
    # What an earlier draw has left, such as half of a 64-bit number, must not count.
    generator(9, 9).integers(0, 9, 3, dtype=np.uint32)
    numbers = generator(seed, draw, stream)
    assert np.array_equal(numbers.standard_normal(7), expected.standard_normal(7))
    assert np.array_equal(numbers.integers(0, 2**31, 5), expected.integers(0, 2**31, 5))
