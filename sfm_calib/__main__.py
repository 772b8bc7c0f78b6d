"""`python -m sfm_calib`."""

import sys

from sfm_calib.cli import main

sys.exit(main())
