"""Settings of all tests."""

import os

from hypothesis import settings

# In CI the same change must give the same answer twice; elsewhere every run looks at new cases.
settings.register_profile("ci", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("ci")
