"""A station that measures range and bearing: across the cut at pi, and close by behind a relay that fades."""

from heliograph_studies.range_bearing import compute, figures
from heliograph_studies.range_bearing.setting import Setting as Setting
from heliograph_studies.study import Study

example = Study("range-bearing", Setting, compute.compute, 4, figures.figures, figures.words)
run = example.run
