"""Constants of nature and units, in nm, ps, dalton and kJ/mol."""

#: Gas constant, kJ/mol/K (CODATA 2018).
GAS_CONSTANT = 8.31446261815324e-3

#: Pressure of 1 bar, kJ/mol/nm^3.
BAR = 0.0602214076

#: Density of 1 g/cm^3, dalton/nm^3.
GRAM_PER_CM3 = 602.214076
