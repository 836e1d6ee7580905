"""Move the bodies of a Context."""
