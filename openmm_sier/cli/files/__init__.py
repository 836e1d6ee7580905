"""The files of a run: outputs, checkpoints, locks and restarts."""
