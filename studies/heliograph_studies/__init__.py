"""Studies made of the library's public parts: publications reproduced and examples, each in a folder of its own.

`heliograph reproduce` and `heliograph example` list and run them; in Python each is a module with `Setting` and `run`.
What all of them are made of stands here; figures are in `curves`.
"""

from heliograph_studies.markdown import stated
from heliograph_studies.outcome import Inline, Unlisted
from heliograph_studies.settings import NO_FILE, File, check_fields
from heliograph_studies.stages import Stages
from heliograph_studies.statement import Sampled, Statement, sampled
from heliograph_studies.study import Study

__all__ = [
    "NO_FILE", "File", "Inline", "Sampled", "Stages", "Statement",
    "Study", "Unlisted", "check_fields", "sampled", "stated",
]  # fmt: skip
