"""The laboratory beside the package: ``python -m benchmarks`` measures speed, ``python -m benchmarks.paper`` executes
the paper's experiments, and other modules measure ablations, plans, evaluators and diagnoses."""
