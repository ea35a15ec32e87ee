"""Study of radio ranges with losses and outliers: drives of an outdoor ultra-wideband recording."""
