# SPDX-License-Identifier: BSD-3-Clause
"""How good is it, against what: generated scenes, baselines, tables and benchmarks."""
