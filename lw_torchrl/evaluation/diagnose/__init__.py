"""Diagnosis of failed episodes: re-run them with one part of the policy replaced, and report the cause as data."""
