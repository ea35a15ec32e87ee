"""Times of rows: with dates and zones, as they are given, and rows as a user gives them."""
