# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Visual relocalization for ROS 2 by Geometry-Aided Matching."""

__version__ = '0.1.0'
