"""What moves the bodies of a Context."""
