"""Meta-World's dense reward of many rows at once."""
