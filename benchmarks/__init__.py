"""What lw_torchrl costs: ``python -m benchmarks``. Every row is a ratio measured in one run; docs/performance.md
says against what."""
