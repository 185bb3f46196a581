"""`python -m apps` does what `tofclip` does."""

import sys

from tofclip.__main__ import main

sys.exit(main())
