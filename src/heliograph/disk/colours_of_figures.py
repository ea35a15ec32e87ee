"""Colours of all figures, in the order in which filters and curves take them."""

# Okabe and Ito's palette, which people with colour blindness can tell apart; then grey.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#b05c92", "#e69f00", "#66727f")
