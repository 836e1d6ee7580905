"""Energy error against cost, compared with other programs, and timing."""
