"""Pictures for people: the scene, figures and plots."""
