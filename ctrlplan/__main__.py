"""``python -m ctrlplan`` is the command ``ctrlplan``."""

import sys

from ctrlplan.cli import main

sys.exit(main())
