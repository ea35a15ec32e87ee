"""Public names of the room, which needs the extra `report`; the package loads them when first used."""

from .diagnosis.health import (
    FilterHealth as FilterHealth,
)
from .diagnosis.recording_diagnosis import (
    examine as examine,
)
from .diagnosis.arrivals import (
    Arrivals as Arrivals,
)
from .pages.run import (
    run_figures as run_figures,
    run_page as run_page,
)
from .pages.run_summary import (
    run_summary as run_summary,
)
from .figures import (
    png as png,
    svg as svg,
)
from .pages.page import (
    Code as Code,
    Judged as Judged,
    KeyFigure as KeyFigure,
    KeyFigures as KeyFigures,
    Page as Page,
    Picture as Picture,
    Points as Points,
    Section as Section,
    Statements as Statements,
    Table as Table,
    Text as Text,
)
