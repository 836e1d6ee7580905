"""Changes a System for long steps."""
