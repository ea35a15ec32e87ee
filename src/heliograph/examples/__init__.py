"""Networks written as users write them; each file runs with `heliograph run`."""
