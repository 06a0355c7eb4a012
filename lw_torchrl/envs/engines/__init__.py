"""The simulators: Meta-World's own environments in a loop, and the fast engine with the same numbers."""
