"""Guaranteed ratios of energies: growth bounds, designs by matrix inequalities, certificates."""
