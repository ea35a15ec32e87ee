"""Self-contained pages: one class that makes them, and one file for each kind of page."""
