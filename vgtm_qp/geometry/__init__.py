"""Distances between the bodies of an arm and obstacles, and between bodies."""
