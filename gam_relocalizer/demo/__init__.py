# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The demo scene: a textured world, a renderer with exact truth, camera paths and recordings."""
