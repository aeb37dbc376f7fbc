"""A proof, or a refutation, for a trajectory that anybody made."""
