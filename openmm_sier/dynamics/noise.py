"""Random numbers that are a function of a seed and of counters alone, so that a restart draws the same ones."""

# Without this, annotations would import numpy.random, which is slow.
from __future__ import annotations

import threading

import numpy as np

#: For each thread one generator, whose state is set for each draw: to make a new one takes five times as long.
_own = threading.local()


def generator(seed: int, draw: int, stream: int = 0) -> np.random.Generator:
    """Return the generator of one draw, which is valid until the next call in the same thread.

    Args:
        seed: of the run, 0 <= seed < 2^128.
        draw: number of earlier draws.
        stream: distinguishes users of one seed: 0 is the thermostat, 1 the volume move, 2 the decision on a trial,
            3 the momentum of the centre of mass, 4 velocities that users ask for, 5 the kinetic energy of a trial.

    >>> bool(generator(1, 5).random() == generator(1, 5).random())
    True
    >>> bool(generator(1, 5).random() == generator(1, 6).random())
    False
    """
    if not hasattr(_own, "generator"):
        _own.philox = np.random.Philox(0)
        _own.generator = np.random.Generator(_own.philox)
    # As np.random.Philox(key=seed, counter=[0, 0, draw, stream]) begins; Philox reads lists faster than arrays.
    _own.philox.state = {
        "bit_generator": "Philox",
        "state": {
            "counter": [0, 0, draw, stream],
            "key": [seed & 0xFFFFFFFFFFFFFFFF, seed >> 64],
        },
        "buffer": [0, 0, 0, 0],
        "buffer_pos": 4,
        "has_uint32": 0,
        "uinteger": 0,
    }
    return _own.generator
