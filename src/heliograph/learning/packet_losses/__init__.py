"""Laws of losses, learned and compared."""
