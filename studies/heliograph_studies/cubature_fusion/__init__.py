"""Cubature Kalman fusion filtering under amplify-and-forward relays, reproduced and repaired; see README.md."""

from heliograph_studies.cubature_fusion import compute, figures, statements
from heliograph_studies.cubature_fusion.setting import Setting as Setting
from heliograph_studies.study import Study

publication = Study(
    name="cubature-fusion",
    setting=Setting,
    compute=compute.compute,
    stages=5,
    figures=figures.figures,
    words=figures.words,
    publication="Cubature Kalman fusion filtering under amplify-and-forward relays with randomly varying channel "
    "parameters",
    statements=statements.statements,
    data=compute.write_record,
    needs=("xarray", "h5netcdf"),
)
run = publication.run
