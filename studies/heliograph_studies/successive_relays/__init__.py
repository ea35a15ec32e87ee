"""Recursive filtering with filter-and-forward successive relays, reproduced and repaired; see README.md."""

from heliograph_studies.study import Study
from heliograph_studies.successive_relays import compute, figures, statements
from heliograph_studies.successive_relays.setting import Setting as Setting

publication = Study(
    name="successive-relays",
    setting=Setting,
    compute=compute.compute,
    stages=4,
    figures=figures.figures,
    words=figures.words,
    publication="Recursive filtering for stochastic systems with filter-and-forward successive relays",
    statements=statements.statements,
    data=compute.write_record,
)
run = publication.run
