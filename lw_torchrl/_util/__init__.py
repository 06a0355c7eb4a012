"""Tools that serve all folders: argument checks, files, keys, devices, progress, registries, seeds."""
