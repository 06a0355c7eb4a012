"""Diagnosis of failed episodes: re-run each one with one part of the policy replaced, and report the cause in
machine-readable form.
"""
