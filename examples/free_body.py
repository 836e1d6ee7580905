#!/usr/bin/env python3
"""A body that tumbles freely: turned about its middle axis it flips over, again and again, as T-handles do in orbit.

Only the exact free rotation is used, without OpenMM. The step may have any length: one step over the whole time ends
where many short steps do.
"""

import argparse

import numpy as np

from openmm_sier.dynamics import rotation

MOMENTS = np.array([1.0, 2.0, 3.0])  #: dalton nm^2
TILT = 1e-3  #: radian between the angular momentum and the middle axis at the start


def start():
    """Attitude (3, 3, 1), whose rows are the principal axes in the lab frame, and angular momentum (3, 1), along y."""
    cos, sin = np.cos(TILT), np.sin(TILT)
    A = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])[:, :, None]
    return A, np.array([[0.0], [4.0], [0.0]])


def energy(A, L):
    return float(0.5 * ((np.einsum("abn,bn->an", A, L) ** 2).T / MOMENTS).sum())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--time", type=float, default=40.0, help="ps (default: 40)")
    parser.add_argument("--step", type=float, default=1.0, help="ps between two lines (default: 1)")
    options = parser.parse_args()

    first_A, first_L = A, L = start()
    steps = round(options.time / options.step)
    flips, sign = 0, 1.0
    print("  time   middle axis along L")
    print("    ps  -1                   0                   1")
    for i in range(steps + 1):
        cosine = float(A[1, :, 0] @ L[:, 0] / np.linalg.norm(L))
        print(f"{i * options.step:6.1f}   {' ' * round(20 * (cosine + 1))}*")
        flips += cosine * sign < 0
        sign = np.sign(cosine)
        if i < steps:
            A, L = rotation.exact(A, L, MOMENTS, options.step)

    at_once, _ = rotation.exact(first_A, first_L, MOMENTS, steps * options.step)
    print(f"\nThe body turned over {flips} times in {steps * options.step:g} ps.")
    print(f"Its energy changed by {abs(energy(A, L) - energy(first_A, first_L)):.1e} of {energy(A, L):.4f} kJ/mol,")
    print(f"its angular momentum by {np.abs(L - first_L).max():.1e} of {np.linalg.norm(L):.1f} dalton nm^2/ps.")
    print(f"One step of {steps * options.step:g} ps ends in the same attitude within {np.abs(A - at_once).max():.1e}.")


if __name__ == "__main__":
    main()
