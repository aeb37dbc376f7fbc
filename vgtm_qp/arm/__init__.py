"""Arms: what a step may know of one, and the arms there are."""
