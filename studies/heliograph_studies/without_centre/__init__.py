"""A network without a centre: what every node's error is, what it claims, and what no rule could do better."""

from heliograph_studies.study import Study
from heliograph_studies.without_centre import compute, figures
from heliograph_studies.without_centre.setting import Setting as Setting

example = Study("without-centre", Setting, compute.compute, 3, figures.figures, figures.words)
run = example.run
