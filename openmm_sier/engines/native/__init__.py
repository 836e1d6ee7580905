"""The native engine: a scheme as the program of a CustomIntegrator."""
