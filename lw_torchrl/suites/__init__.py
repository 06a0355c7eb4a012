"""Tasks of other simulators than Meta-World, in its words and axes."""
