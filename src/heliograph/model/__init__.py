"""What is observed and how: plants, sensors, channels, relays, over time; and what an estimate is."""
