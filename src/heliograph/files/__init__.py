"""Networks, recordings and tables in files."""
