"""Rows of the QP: one file a kind, each equation of the paper once, as functions of symbols or arrays.

The functions know neither arms nor layouts. Symbols are CasADi's; arrays go through a ``casadi.Function``
made of the same expression, as in :func:`vgtm_qp.rows.tip.tip_function`.
"""
