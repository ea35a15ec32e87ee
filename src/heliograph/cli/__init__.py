"""The command `heliograph`: it reads files, calls the library and writes files. Help must not import JAX."""

from heliograph.cli.command import BAD_INPUT as BAD_INPUT
from heliograph.cli.command import main as main
from heliograph.cli.measured_data import ReadingOptions as ReadingOptions
from heliograph.cli.run_in_blocks import AllRowsNeededError as AllRowsNeededError
from heliograph.cli.run_in_blocks import filter_in_blocks as filter_in_blocks
from heliograph.cli.run_in_blocks import is_long as is_long
from heliograph.cli.stop_signals import INTERRUPTED as INTERRUPTED
from heliograph.cli.stop_signals import SIGNALLED as SIGNALLED
from heliograph.cli.stop_signals import TERMINATED as TERMINATED
from heliograph.cli.stop_signals import GentleStop as GentleStop
from heliograph.numerics.process.optional_packages import EXTRAS as EXTRAS
