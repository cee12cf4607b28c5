# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Maps, and what was localized in them, in the interactive 3D viewer rerun."""
