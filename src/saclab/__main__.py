"""`python -m saclab` is the command `saclab`."""

import sys

from saclab.cli.main import main

sys.exit(main())
