"""Public names of the package, which loads them when first used."""

from .compiled import (
    compile as compile,
    compile_one as compile_one,
    explain as explain,
)
from .scan_over_rows import (
    compile_scan as compile_scan,
)
from .sums_over_runs import (
    accumulate as accumulate,
)
from .rules.never_nan_marks import (
    present as present,
)
from .nodes import (
    Unsupported as Unsupported,
)
from .c_function import (
    to_c as to_c,
)
from .rules.custom_operations import (
    operation as operation,
)
