# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Virtual arrows in a map, drawn into recordings: how steady and how right poses look."""
