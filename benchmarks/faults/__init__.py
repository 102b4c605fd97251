"""What can be done to a run without harm: `python -m benchmarks.faults`, a part a file."""
