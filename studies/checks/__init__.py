"""Long checks: runs that are killed, drift over millions of steps, sampled ensembles."""
