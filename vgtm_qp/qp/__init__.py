"""The QP of one step: its layout and numbers, its forms, and a solver for each."""
