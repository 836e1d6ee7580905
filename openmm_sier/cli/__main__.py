"""`python -m openmm_sier.cli` is the command `openmm-sier`."""

import sys

from openmm_sier.cli.main import main

sys.exit(main())
