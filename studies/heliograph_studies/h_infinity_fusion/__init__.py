"""Quantized H-infinity fusion over amplify-and-forward relays, reproduced and judged; see README.md."""

from heliograph_studies.h_infinity_fusion import compute, figures, statements
from heliograph_studies.h_infinity_fusion.setting import Setting as Setting
from heliograph_studies.study import Study

publication = Study(
    name="h-infinity-fusion",
    setting=Setting,
    compute=compute.compute,
    stages=6,
    figures=figures.figures,
    words=figures.words,
    publication="Distributed fusion filtering for nonlinear time-varying systems over amplify-and-forward relay "
    "networks: an H-infinity quantized framework",
    statements=statements.statements,
    data=compute.write_record,
    needs=("clarabel", "cvxpy", "xarray", "h5netcdf"),
)
run = publication.run
