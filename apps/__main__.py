"""`python -m apps` does what `tofclip` does."""

import sys

from apps.cli import main

sys.exit(main())
