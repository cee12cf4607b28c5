# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""From an image to a pose in the map, with a covariance and a verdict."""
