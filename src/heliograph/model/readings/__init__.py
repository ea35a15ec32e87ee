"""What a node believes of its readings: limits, codes of failure, repetitions, and timeouts."""
