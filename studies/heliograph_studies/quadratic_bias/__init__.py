"""Quadratic filtering with dynamical bias under amplify-and-forward relays, reproduced and repaired; see README.md."""

from heliograph_studies.quadratic_bias import compute, figures, statements
from heliograph_studies.quadratic_bias.setting import Setting as Setting
from heliograph_studies.study import Study

publication = Study(
    name="quadratic-bias",
    setting=Setting,
    compute=compute.compute,
    stages=3,
    figures=figures.figures,
    words=figures.words,
    publication="Quadratic filtering with dynamical bias under amplify-and-forward relays",
    statements=statements.statements,
    data=compute.write_record,
    needs=("xarray", "h5netcdf"),
)
run = publication.run
