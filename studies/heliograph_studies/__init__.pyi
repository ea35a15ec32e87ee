"""Public names of the studies; the package loads them when first used."""

from .markdown import (
    stated as stated,
)
from .outcome import (
    Inline as Inline,
)
from .outcome import (
    Unlisted as Unlisted,
)
from .settings import (
    NO_FILE as NO_FILE,
)
from .settings import (
    File as File,
)
from .settings import (
    check_fields as check_fields,
)
from .stages import (
    Stages as Stages,
)
from .statement import (
    Sampled as Sampled,
)
from .statement import (
    Statement as Statement,
)
from .statement import (
    sampled as sampled,
)
from .study import (
    Study as Study,
)
