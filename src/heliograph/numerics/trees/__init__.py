"""Objects as their arrays and what else they are; trees of arrays as rows; traced programs as text."""
