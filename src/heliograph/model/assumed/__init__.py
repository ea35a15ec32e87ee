"""What a filter believes of the world, and whether that is the world it stands in."""
