# SPDX-License-Identifier: BSD-3-Clause
"""`python -m vprism_plan.cli`: the same as `vprism-plan`."""

import sys

from vprism_plan.cli import main

sys.exit(main())
