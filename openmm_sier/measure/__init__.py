"""Starts, samples and observables, without a command line."""
