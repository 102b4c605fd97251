"""A run on disk and its life: its files, checkpoints, progress, signals and processes."""
