"""Kernels by which OpenMM's platforms for GPUs execute the integrators of openmm-sier.

`openmm_sier` loads this package where it is installed. `library` returns the compiled library of a platform, which
takes over the steps of a CustomIntegrator that `Library.assign` gave a program. All other CustomIntegrators are
OpenMM's.
"""

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import openmm

from openmm_sier_kernels.built_for import VERSION

#: Kinds of command, as in `program.h`.
KINDS = {"update": 0, "forces": 1, "launch": 2, "sites": 3, "forces and energy": 4, "reorder": 5, "restored": 6}

FOLDER = Path(__file__).parent

_INTEGERS = ctypes.POINTER(ctypes.c_int)
_NUMBERS = ctypes.POINTER(ctypes.c_double)

#: Results and arguments of the library's functions.
_FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "new_program": (ctypes.c_void_p, []),
    "add_source": (None, [ctypes.c_void_p, ctypes.c_char_p]),
    "add_integers": (None, [ctypes.c_void_p, ctypes.c_char_p, _INTEGERS, ctypes.c_int]),
    "add_numbers": (None, [ctypes.c_void_p, ctypes.c_char_p, _NUMBERS, ctypes.c_int]),
    "add_totals": (None, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int]),
    "add_kernel": (None, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, *[ctypes.c_int] * 4]),
    "add_block": (None, [ctypes.c_void_p]),
    "add_command": (None, [ctypes.c_void_p, *[ctypes.c_int] * 2]),
    "add_bodies": (None, [ctypes.c_void_p, ctypes.c_int, _INTEGERS, ctypes.c_int, ctypes.c_int]),
    "assign": (None, [ctypes.c_void_p, ctypes.c_void_p]),
    "forget": (None, [ctypes.c_void_p, ctypes.c_void_p]),
    "is_executed": (ctypes.c_int, [ctypes.c_void_p]),
    "set_scalars": (None, [ctypes.c_void_p, ctypes.c_double, _NUMBERS, ctypes.c_int]),
    "run": (ctypes.c_char_p, [ctypes.c_void_p, *[ctypes.c_int] * 3, _NUMBERS]),
    "write_numbers": (None, [ctypes.c_void_p, ctypes.c_char_p, _NUMBERS]),
    "clear_totals": (None, [ctypes.c_void_p, ctypes.c_char_p]),
    "read_totals": (None, [ctypes.c_void_p, ctypes.c_char_p, _NUMBERS]),
    "read_vectors": (None, [ctypes.c_void_p, ctypes.c_char_p, _NUMBERS]),
    "take_total": (ctypes.c_double, [ctypes.c_void_p, ctypes.c_char_p]),
}


def platforms() -> tuple[str, ...]:
    """Return the names of OpenMM's platforms for which a library was built."""
    return tuple(name for name in ("CUDA", "HIP", "OpenCL") if _path_of(name) is not None)


def _path_of(platform: str) -> Path | None:
    return next(iter(FOLDER.glob(f"libSIERKernels{platform}.*")), None)


@cache
def library(platform: str) -> "Library":
    """Return the library of one of OpenMM's platforms, which is loaded by the first call.

    Args:
        platform: its name, such as "OpenCL".

    Raises:
        openmm.OpenMMException: there is none, or it was built for another version of OpenMM.
    """
    version = openmm.__version__
    if version != VERSION:
        raise openmm.OpenMMException(
            f"openmm-sier-kernels was built for OpenMM {VERSION}, and this is OpenMM {version}: build it again in this "
            "environment, by pip install scikit-build-core cmake ninja, and then "
            "pip install --no-build-isolation --no-deps --force-reinstall ./kernels"
        )
    path = _path_of(platform)
    if path is None:
        built = ", ".join(platforms())
        raise openmm.OpenMMException(
            f"openmm-sier-kernels was built for {built}, and not for the {platform} platform: take another platform, "
            "or build it again where that one and its headers are installed"
        )
    openmm.Platform.loadPluginLibrary(str(path))
    return Library(path)


def _integers(values: Any) -> tuple[np.ndarray, Any]:
    array = np.ascontiguousarray(values, dtype=np.int32)
    return array, array.ctypes.data_as(_INTEGERS)


def _numbers(values: Any) -> tuple[np.ndarray, Any]:
    array = np.ascontiguousarray(values, dtype=np.float64)
    return array, array.ctypes.data_as(_NUMBERS)


class Library:
    """The compiled library of a platform. Integrators are named by their address, `int(integrator.this)`."""

    def __init__(self, path: Path) -> None:
        loaded = ctypes.CDLL(str(path))
        self._functions = {}
        for name, (result, arguments) in _FUNCTIONS.items():
            function = getattr(loaded, f"sier_{name}")
            function.restype = result
            function.argtypes = arguments
            self._functions[name] = function

    def _call(self, name: str, *arguments: Any) -> Any:
        return self._functions[name](*arguments)

    def assign(self, integrator: int, program: Any) -> int:
        """Give an integrator without a Context a program, and return its number for `forget`.

        Args:
            integrator: its address.
            program: has the attributes of `openmm_sier.engines.compiled.step_program.StepProgram`.
        """
        made = self._call("new_program")
        for source in program.sources:
            self._call("add_source", made, source.encode())
        for name, values in program.integers.items():
            array, pointer = _integers(values)
            self._call("add_integers", made, name.encode(), pointer, array.size)
        for name, values in program.numbers.items():
            array, pointer = _numbers(values)
            self._call("add_numbers", made, name.encode(), pointer, array.size)
        for name, size in program.totals.items():
            self._call("add_totals", made, name.encode(), size)
        for kernel in program.kernels:
            arguments = " ".join(kernel.arguments).encode()
            numbers = kernel.threads, kernel.block, kernel.noise, kernel.moves_atoms
            self._call("add_kernel", made, kernel.name.encode(), kernel.source, arguments, *numbers)
        for commands in program.blocks:
            self._call("add_block", made)
            for kind, number in commands:
                self._call("add_command", made, KINDS[kind], number)
        for kind, atoms in enumerate(program.bodies):
            array, pointer = _integers(atoms)
            self._call("add_bodies", made, kind, pointer, *array.shape)
        self._call("assign", integrator, made)
        return int(made)

    def forget(self, integrator: int, program: int) -> None:
        """Take a program from an integrator, unless it has another one by now: OpenMM executes its steps then."""
        self._call("forget", integrator, program)

    def is_executed(self, integrator: int) -> bool:
        """Return whether a Context executes the program of an integrator."""
        return bool(self._call("is_executed", integrator))

    def set_scalars(self, integrator: int, step: float, values: Any) -> None:
        """Set the step, ps, and the scalars of a program, always of the same number, for the steps that follow."""
        array, pointer = _numbers(values)
        self._call("set_scalars", integrator, step, pointer, array.size)

    def run(self, integrator: int, block: int, times: int, are_forces_known: bool) -> float:
        """Execute a block of commands several times, and return the sum of the energies that it asks for, kJ/mol.

        Args:
            integrator: its address.
            block: its number.
            times: how often.
            are_forces_known: whether nobody has changed the Context since the last block or step.

        Raises:
            openmm.OpenMMException: it failed.
        """
        energy = ctypes.c_double()
        message = self._call("run", integrator, block, times, are_forces_known, ctypes.byref(energy))
        if message is not None:
            raise openmm.OpenMMException(message.decode())
        return energy.value

    def write_numbers(self, integrator: int, name: str, values: Any) -> None:
        """Write a table of numbers, all of them."""
        _, pointer = _numbers(values)
        self._call("write_numbers", integrator, name.encode(), pointer)

    def clear_totals(self, integrator: int, name: str) -> None:
        """Set sums to zero."""
        self._call("clear_totals", integrator, name.encode())

    def read_totals(self, integrator: int, name: str, size: int) -> np.ndarray:
        """Return so many sums, each as an integer."""
        array, pointer = _numbers(np.zeros(size))
        self._call("read_totals", integrator, name.encode(), pointer)
        return array

    def read_vectors(self, integrator: int, name: str, number: int) -> np.ndarray:
        """Return a table of vectors of atoms, (N, 3); zeros before the first step.

        Args:
            integrator: its address.
            name: of the table.
            number: of atoms, N.
        """
        array, pointer = _numbers(np.zeros((number, 3)))
        self._call("read_vectors", integrator, name.encode(), pointer)
        return array

    def take_total(self, integrator: int, name: str) -> float:
        """Return a sum of a program, and set it to zero."""
        return float(self._call("take_total", integrator, name.encode()))
