# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Local and global image features."""

from gam_relocalizer.features.registry import EXTRACTOR_NAMES, create_extractor

__all__ = ['EXTRACTOR_NAMES', 'create_extractor']
