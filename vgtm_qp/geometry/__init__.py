"""Distances between the members of an arm and obstacles, and between members."""
