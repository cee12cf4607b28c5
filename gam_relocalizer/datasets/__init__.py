# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Readers of published datasets: images, cameras and true poses, in the layouts people have."""
