"""Which field of which message is which number of a network."""
