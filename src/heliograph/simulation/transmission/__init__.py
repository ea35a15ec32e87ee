"""From the plant to the filters: sensors, channels, relays, and what several links share."""
