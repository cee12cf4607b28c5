# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node; nothing outside this room knows a message type."""
