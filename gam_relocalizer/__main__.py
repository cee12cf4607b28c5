# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`python -m gam_relocalizer`: the same as the `gam_relocalizer` command."""

from gam_relocalizer.cli.main import main

if __name__ == '__main__':
    main()
