"""The same maneuver by several methods, in one report."""
