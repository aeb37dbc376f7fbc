"""Rows of the QP: one file a kind, each equation of the paper once, as functions of symbols or arrays.

They know neither arms nor layouts. Symbols are CasADi's; an array goes through a ``casadi.Function`` made of the same
expression, as :func:`vgtm_qp.rows.tip.tip_function` shows.
"""
