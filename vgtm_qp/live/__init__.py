"""The live page: an arm that follows a hand, in a browser on this machine."""
