"""Radio ranges with losses and outliers: drives of an outdoor ultra-wideband recording, and filters that doubt."""

from pathlib import Path

from heliograph_studies.study import Study
from heliograph_studies.uwb import compute, figures
from heliograph_studies.uwb.setting import Setting as Setting


def files(setting: Setting) -> list[Path]:
    """The tables of the recording."""
    return sorted(Path(setting.recording).rglob("*.csv")) if setting.recording else []


example = Study("uwb", Setting, compute.compute, 2, figures.figures, figures.words, files=files)
run = example.run
