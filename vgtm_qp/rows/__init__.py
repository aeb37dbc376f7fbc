"""Rows of the QP: one file a kind."""
