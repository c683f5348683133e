"""`python -m improvo`."""

import sys

from improvo.cli.main import main

sys.exit(main())
