"""Commands sent to a GPU per step, counted without one: kernels, copies, reads and writes, and time in Python.

    python -m studies.launches [--boxes tip3p-512] [--methods sier2 sier4g] [--precisions mixed]

OpenMM's platforms for GPUs send the same commands to any device. Its OpenCL platform runs on CPUs too, with the
packages of the extra `opencl-test`. There a library that is compiled of `commands.c`, which takes a C compiler, stands
between OpenMM and OpenCL and counts. Each case has a process of its own. The counts of a step and of a call of `step`
follow from calls of one step and of many. Writes launches.json.
"""
