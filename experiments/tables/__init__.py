# SPDX-License-Identifier: BSD-3-Clause
"""Experiments over many scenes: the runner, and the tables that are made with it."""
