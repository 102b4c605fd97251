"""A run on disk and its execution: files, checkpoints, progress, signals and processes."""
