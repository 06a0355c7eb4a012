"""The paper's experiments (``python -m benchmarks.paper``): recipes, runs, and comparisons with published results."""
