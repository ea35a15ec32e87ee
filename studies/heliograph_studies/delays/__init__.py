"""Data that come late, with time stamps or without, and clocks that are wrong: what filters claim, and what is true."""

from heliograph_studies.delays import compute, figures
from heliograph_studies.delays.setting import Setting as Setting
from heliograph_studies.study import Study

example = Study("delays", Setting, compute.compute, 4, figures.figures, figures.words)
run = example.run
