"""States that are no numbers on a line: angles, attitudes as rotation vectors."""
