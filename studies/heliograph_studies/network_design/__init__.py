"""Networks that are designed: powers, relays, sites and schedules, each beside what nothing can beat."""

from heliograph_studies.demo.recording import plaza2
from heliograph_studies.network_design import compute, figures
from heliograph_studies.network_design.setting import Setting as Setting
from heliograph_studies.study import Study

example = Study("network-design", Setting, compute.compute, 7, figures.figures, figures.words, files=plaza2)
run = example.run
