"""Networks run: simulated, filtered, recorded, and judged by statistics."""
