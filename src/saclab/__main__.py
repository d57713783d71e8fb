"""`python -m saclab` is the command `saclab`."""

import sys

from saclab.cli import main

sys.exit(main())
