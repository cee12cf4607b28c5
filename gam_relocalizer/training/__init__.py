# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Training of the matching networks on synthetic scenes and on maps."""
