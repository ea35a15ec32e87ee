"""A network's filters kept running: messages in, estimates out, exactly once in effect."""
