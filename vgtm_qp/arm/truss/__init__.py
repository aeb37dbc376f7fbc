"""Trusses as data, and their kinematics."""
