"""What a person sees: the scene, the live page and the plots."""
