"""Public names of the room; the package loads them when first used."""

from .fitting import (
    Fit as Fit,
)
from .identification import (
    Identifiability as Identifiability,
)
from .many import (
    FitEach as FitEach,
    fit_each as fit_each,
)
from .parameters import (
    Description as Description,
    Parameters as Parameters,
    describe as describe,
)
from .solution import (
    Row as Row,
)
