"""Helpers used by all subpackages: argument checks, files, tensordict keys, devices, progress, registries and seeds."""
