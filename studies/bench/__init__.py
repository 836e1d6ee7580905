"""Energy error against cost, beside other programs, and how timings are taken."""
