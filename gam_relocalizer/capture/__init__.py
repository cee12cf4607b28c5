# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Videos and bags in, keyframes and what is known of them out."""
