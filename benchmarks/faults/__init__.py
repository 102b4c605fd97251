"""Failures that a run must survive: `python -m benchmarks.faults`; each file is one part."""
