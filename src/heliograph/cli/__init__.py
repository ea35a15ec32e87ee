"""The command `heliograph`: it reads files, calls the library and writes files. Help must not import JAX."""

from heliograph.cli.command import BAD_INPUT as BAD_INPUT
from heliograph.cli.command import main as main
from heliograph.cli.stopping import INTERRUPTED as INTERRUPTED
from heliograph.cli.stopping import SIGNALLED as SIGNALLED
from heliograph.cli.stopping import TERMINATED as TERMINATED
from heliograph.cli.stopping import GentleStop as GentleStop
from heliograph.numerics.process.extras import EXTRAS as EXTRAS
