"""The measuring instrument: the time of a step by phase, beside baselines that take the same steps."""
