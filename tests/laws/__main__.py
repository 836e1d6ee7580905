"""Tries ever new examples of the laws.

    python -m tests.laws [--minutes 60] [--law order …] [--platform CPU] [--engine kernels] [--seed 1] [--examples 50]

Laws are tried by turns, with a new seed in each round. A law that does not hold is printed with its smallest case, as
Python that makes it again, and with the command that finds it again. It is left out from then on; the status is 1.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import time
import warnings

from tests.laws import (
    test_averages,
    test_completed_steps,
    test_damping,
    test_energies,
    test_force_checks,
    test_future,
    test_order,
    test_preparing,
    test_pressures,
    test_readers,
    test_refusals,
    test_requests,
    test_reversal,
    test_symplectic,
    test_updates,
    test_volume_moves,
    test_wholes,
)
from tests.laws.law import Broken, Law
from tests.support import kernels, opencl

#: All laws by their names.
MODULES = (
    test_order,
    test_damping,
    test_reversal,
    test_symplectic,
    test_preparing,
    test_requests,
    test_future,
    test_completed_steps,
    test_energies,
    test_volume_moves,
    test_updates,
    test_averages,
    test_pressures,
    test_wholes,
    test_force_checks,
    test_readers,
    test_refusals,
)
LAWS = {law.name: law for module in MODULES for law in vars(module).values() if isinstance(law, Law)}


def arguments() -> argparse.Namespace:
    """Return what the command line asks for."""
    parser = argparse.ArgumentParser(prog="python -m tests.laws", description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0, help="no new round begins after this time")
    parser.add_argument("--law", nargs="+", choices=LAWS, default=list(LAWS), help="names of laws")
    parser.add_argument("--platform", default="Reference", help="name of the platform")
    parser.add_argument("--engine", help="of all examples; those that laws draw unless given")
    parser.add_argument("--seed", type=int, help="of one round, which is then the only one")
    parser.add_argument("--examples", type=int, default=50, help="number of examples of each law in a round")
    return parser.parse_args()


def main() -> int:
    asked = arguments()
    if asked.platform == "OpenCL" and not opencl.has_environment():
        # OpenMM looks for its runtime when Python starts.
        command = [sys.executable, "-m", "tests.laws", *sys.argv[1:]]
        return subprocess.run(command, env=opencl.environment(optimizes=False), check=False).returncode
    if asked.engine == "kernels" and not kernels.are_here():
        print(kernels.MISSING, file=sys.stderr)
        return 2
    warnings.simplefilter("ignore")
    end, tried = time.monotonic() + 60 * asked.minutes, dict.fromkeys(asked.law, 0)
    broken: set[str] = set()
    while len(broken) < len(tried):
        seed = random.SystemRandom().randrange(2**32) if asked.seed is None else asked.seed
        for name in tried.keys() - broken:
            try:
                LAWS[name].hold(asked.examples, asked.platform, seed, asked.engine)
            except Broken as fault:
                place = f"--platform {asked.platform}" + f" --engine {asked.engine}" * bool(asked.engine)
                options = f"{place} --seed {seed} --examples {asked.examples}"
                print(f"\n{fault}\n    python -m tests.laws --law {name} {options}", flush=True)
                broken.add(name)
            tried[name] += asked.examples
        if asked.seed is not None or time.monotonic() > end:
            break
    print(", ".join(f"{name}: {count} examples{' BROKEN' * (name in broken)}" for name, count in tried.items()))
    return bool(broken)


if __name__ == "__main__":
    sys.exit(main())
