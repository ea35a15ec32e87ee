"""Packets that a recorded radio network delivered late, out of order and twice, and what a filter makes of them."""

from heliograph_studies.demo.recording import plaza2
from heliograph_studies.late_data import compute, figures
from heliograph_studies.late_data.setting import Setting as Setting
from heliograph_studies.study import Study

example = Study("late-data", Setting, compute.compute, 3, figures.figures, figures.words, files=plaza2)
run = example.run
