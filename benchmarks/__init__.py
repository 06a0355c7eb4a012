"""Experiments with the package: ``python -m benchmarks`` measures speed, ``python -m benchmarks.paper`` runs the
paper's experiments, and other modules evaluate ablations, plans, evaluators and diagnoses."""
