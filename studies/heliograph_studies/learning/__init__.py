"""Links learned from recordings: whether intervals cover the truth behind random gains, method by method."""

from heliograph_studies.demo.recording import plaza2
from heliograph_studies.learning import compute, figures
from heliograph_studies.learning.setting import Setting as Setting
from heliograph_studies.study import Study

example = Study("learning", Setting, compute.compute, 3, figures.figures, figures.words, files=plaza2)
run = example.run
