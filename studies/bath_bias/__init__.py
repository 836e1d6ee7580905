"""How the length of a step biases averages in a heat bath: small liquids, and a law that predicts it."""
