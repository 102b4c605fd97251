"""One question each: `python -m benchmarks.<name>`; the last lines are JSON, one a row."""
