# SPDX-License-Identifier: BSD-3-Clause
"""A second opinion by FCL: the surfaces of a world against the solids of a robot."""
