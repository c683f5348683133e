"""`python -m sivo`."""

import sys

from sivo.cli.main import main

sys.exit(main())
