"""The theory in code: bounds, and exact experiments in tabular MDPs."""
