"""What long steps change around a solute: a harmonic model of molecules and their neighbours."""
