"""The files of a run: what is written, noted, locked and read back."""
