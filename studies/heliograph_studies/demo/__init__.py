"""A mower's recorded ranges to four beacons through a simulated relay, to filters that know it or do not."""

from heliograph_studies.demo import compute, figures
from heliograph_studies.demo.setting import Setting as Setting
from heliograph_studies.study import Study

example = Study(
    "demo",
    Setting,
    compute.compute,
    4,
    figures.figures,
    figures.words,
    data=compute.data,
    needs=["pyarrow"],
    files=Setting.files,
)
run = example.run
