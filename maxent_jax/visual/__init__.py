"""Shows a run: its figures, its videos, and the tables and page of a report."""
