"""`python -m heliograph` is the command `heliograph`."""

import sys

from heliograph.cli import main

sys.exit(main())
