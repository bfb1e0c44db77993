# SPDX-License-Identifier: BSD-3-Clause
"""What things cost, side by side: `python -m experiments.benchmarks.NAME`."""
