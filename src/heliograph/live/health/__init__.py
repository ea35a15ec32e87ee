"""Health of a fleet: counts of lost and implausible messages, silent senders, stuck sensors, and warnings of them."""
