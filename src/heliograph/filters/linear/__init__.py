"""Linear filters, their gains before any data, and their true errors."""
