"""A maneuver as data: arrays, manifest and certificate, and the file that holds them."""
