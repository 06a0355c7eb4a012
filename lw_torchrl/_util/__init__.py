"""Helpers for all folders: argument checks, files, tensordict keys, devices, progress, registries, seeds, versions."""
