"""The live page: an arm that follows the mouse, in a browser on this machine."""
