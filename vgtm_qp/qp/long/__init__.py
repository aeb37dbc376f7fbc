"""The QP of a long arm at a cost linear in its bays: eliminations along the chain of bays."""
