"""Benchmarks: `python -m benchmarks.<name>` answers one question; the last lines are JSON rows."""
