"""Cost of a step on a GPU, compared with OpenMM's integrators, and averages that would reveal a wrong program.

    python -m studies.gpu [--platform CUDA] [--benchmarks openmm/examples/benchmarks] [--boxes dhfr water-4096]

takes boxes of water and DHFR, that of OpenMM's own benchmark where its folder is given, which copies of it (dhfr-8)
need, in mixed precision. LangevinMiddle at 4 fs is as that benchmark has it: bonds to hydrogen constrained, hydrogens
of 1.5 dalton, 1/ps. Prepared Systems have hydrogens of 4 dalton, those of solutes 3. Steps are called by tens, as
`Simulation` calls them, all methods take turns, and times are those of the wall.

In the boxes of `--averages` the potential energy, the temperatures of water, and the energies of bonds, angles and
torsions are averaged over a run, and set beside those of LangevinMiddle at 1 fs. In those of `--energies` the energy of
runs without a bath is followed. With `--chains` so many chains of beads with rigid domains are timed, too, as bodies of
the exact engine, as frames, and with springs. Writes gpu.json.
"""
