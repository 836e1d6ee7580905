"""The exact engine: a Python layer over the Context that rotates bodies exactly."""
