"""Kalman filtering with intermittent observations and its successors, reproduced and judged; see README.md."""

from heliograph_studies.intermittent_observations import compute, figures, statements
from heliograph_studies.intermittent_observations.setting import Setting as Setting
from heliograph_studies.study import Study

publication = Study(
    name="intermittent-observations",
    setting=Setting,
    compute=compute.compute,
    stages=3,
    figures=figures.figures,
    words=figures.words,
    publication="Kalman filtering with intermittent observations",
    statements=statements.statements,
    data=compute.write_record,
)
run = publication.run
