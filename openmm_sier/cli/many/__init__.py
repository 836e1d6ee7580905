"""Many runs that differ in their seeds: `openmm-sier run --seeds`, and `run_many` for scripts."""

from openmm_sier.cli.many.members import Member, run_many

__all__ = ["Member", "run_many"]
