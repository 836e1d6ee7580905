"""Free rotation: the exact solution and the maps that it is compared with."""
