"""From a problem to a maneuver, and the maneuver as data."""
