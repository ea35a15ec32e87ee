"""Fusion that knows what is shared: what intersection throws away, a centre that remembers every report, trees."""

from heliograph_studies.fusion import compute, figures
from heliograph_studies.fusion.setting import Setting as Setting
from heliograph_studies.study import Study

example = Study("fusion", Setting, compute.compute, len(compute.CASES) + 5, figures.figures, figures.words)
run = example.run
