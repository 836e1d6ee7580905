"""The native engine compared with the exact one: energies, baths, cost."""
