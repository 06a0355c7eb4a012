"""Helpers for all subpackages, such as argument checks, files, tensordict keys, devices, progress and registries."""
