"""The native engine beside the exact one: energies, baths, cost."""
