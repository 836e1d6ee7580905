"""The kernels engine: steps that compiled kernels of the package openmm-sier-kernels execute on GPU platforms."""
