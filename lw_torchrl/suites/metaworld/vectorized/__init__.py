"""The fast engine: Meta-World bit for bit, at nearly the speed of its physics."""
