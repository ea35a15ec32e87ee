"""What is checked of the rows that models step over: inputs, times, and values of functions."""
