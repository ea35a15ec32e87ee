"""What waiting is worth: smoothing behind fading links and relays, from a lag of one step to a whole run."""

from heliograph_studies.smoothing import compute, figures
from heliograph_studies.smoothing.setting import Setting as Setting
from heliograph_studies.study import Study

example = Study("smoothing", Setting, compute.compute, 4, figures.figures, figures.words)
run = example.run
