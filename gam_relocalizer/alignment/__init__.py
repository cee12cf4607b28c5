# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Lays a map into a frame that is metric, level, and known to others: finds map_from_sfm."""
