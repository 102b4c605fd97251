"""The theory, executable: bounds, and exact experiments in tabular MDPs."""
