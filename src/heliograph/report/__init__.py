"""Figures and self-contained HTML pages; the only place that imports a plotting library (the extra `report`)."""
