# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Visual relocalization for ROS 2 by Geometry-Aided Matching."""

import os

__version__ = '0.1.0'

MAX_IMAGE_PIXELS = 200_000_000

# OpenCV asks for its limit when it is imported; it then refuses by the size that a file states,
# before it takes memory for the pixels.
os.environ.setdefault('OPENCV_IO_MAX_IMAGE_PIXELS', str(MAX_IMAGE_PIXELS))
# NumPy's own threads keep spinning for a while after each product, beside those of torch, and both
# get slow: with them an attempt takes one and a half times as long on two cores.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
