"""Description of networks in words, and what is doubtful in them before any data."""
