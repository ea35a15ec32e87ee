"""Links that fade slowly: what a filter without memory claims and errs, what memory and side information are worth."""

from heliograph_studies.links_with_memory import compute, figures
from heliograph_studies.links_with_memory.setting import Setting as Setting
from heliograph_studies.study import Study

example = Study("links-with-memory", Setting, compute.compute, 6, figures.figures, figures.words)
run = example.run
