# SPDX-License-Identifier: BSD-3-Clause
"""How the shape prior's network is trained: shapes made on the spot, views of them, a loss."""
