"""The QP of one step: its layout and numbers, its forms, and what solves each."""
