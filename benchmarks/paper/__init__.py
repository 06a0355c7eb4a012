"""The paper's experiments: ``python -m benchmarks.paper``. Recipes, runs, and tables beside the published results."""
