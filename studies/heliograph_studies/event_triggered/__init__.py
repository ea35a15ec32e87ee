"""A house whose rooms report on change over a lossy link: what usual recipes claim, what is true, messages saved."""

from heliograph_studies.event_triggered import compute, figures
from heliograph_studies.event_triggered.setting import Setting as Setting
from heliograph_studies.study import Study

example = Study("event-triggered", Setting, compute.compute, 2, figures.figures, figures.words)
run = example.run
