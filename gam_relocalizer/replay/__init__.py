# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Bags in, trajectory and report out; the same localizer as the node."""
