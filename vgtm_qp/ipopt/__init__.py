"""Yardsticks of general-purpose optimisation: each step as one nonlinear program over the node positions, by IPOPT."""
