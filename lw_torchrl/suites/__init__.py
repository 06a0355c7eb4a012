"""Suites of tasks, each with a robot and a simulator; Meta-World and Fetch are shipped."""

from lw_torchrl.suites.checking import Finding, check_suite
from lw_torchrl.suites.suite import SUITES, Suite, find_suite, known_suite, load_suite

__all__ = ["SUITES", "Finding", "Suite", "check_suite", "find_suite", "known_suite", "load_suite"]
