"""One certified step: from a state and a piece of path to the next state, or a reason to stop."""
