"""Serial arms: joints one after another, each moving all that follows it (section 4.8)."""
