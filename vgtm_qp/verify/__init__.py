"""Checks a maneuver again from its nodes alone, with none of the solver's code."""

from vgtm_qp.verify.check import verify, verify_file

__all__ = ["verify", "verify_file"]
