"""What is shown of a run: its figures, videos, and the tables and page of a report."""
