# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The documentation as a site: `make docs`, or `sphinx-build -c docs . build/docs`.

The source folder is the repository, so that README.md, CONTRIBUTING.md and docs/ link to each other
here as on a git host. Nothing is fetched from anywhere.
"""

import xml.etree.ElementTree as ET
from pathlib import Path

from sphinx.application import Sphinx

REPOSITORY = Path(__file__).parents[1]

project = 'gam_relocalizer'
author = 'gam_relocalizer authors'
project_copyright = '2026, gam_relocalizer authors'
release = ET.parse(REPOSITORY / 'package.xml').findtext('version', '')  # noqa: S314 - our own file

extensions = [
    'myst_parser',
    'sphinx.ext.apidoc',
    'sphinx.ext.autodoc',
    'sphinx.ext.napoleon',
]
root_doc = 'docs/index'
include_patterns = ['*.md', 'docs/*.md', 'docs/api/*.rst']
# looking into these would take long
exclude_patterns = ['.*', 'build', 'install', 'log', 'dist', 'gam_relocalizer*', 'test', 'maps']
html_theme = 'furo'
html_title = f'{project} {release}'
html_extra_path = ['site']

# Anchors as git hosts make them of headings.
myst_heading_anchors = 4
# A reference that begins with our name must lead somewhere; types of others are only named.
nitpicky = True
nitpick_ignore_regex = [
    ('py:.*', r'(?!gam_relocalizer\.).*'),
    ('py:.*', r'gam_relocalizer\.localization\.pictures\.Item'),  # a type variable
]
# Annotations are read as text: two classes of one name cannot be told apart there.
suppress_warnings = ['ref.python']

# A page for each module, written anew with every build.
apidoc_modules = [
    {
        'path': str(REPOSITORY / 'gam_relocalizer'),
        'destination': 'docs/api',
        'separate_modules': True,
        'module_first': True,
        'max_depth': 2,
        # a name that another module offers as well is described where it is defined
        'automodule_options': {'members', 'show-inheritance', 'ignore-module-all'},
    }
]
apidoc_remove_old = True
autodoc_member_order = 'bysource'
autodoc_typehints = 'signature'
napoleon_numpy_docstring = False
# Attributes of a dataclass stand in its signature with their types.
napoleon_use_ivar = True
napoleon_attr_annotations = False


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect('autodoc-process-docstring', _show_listings_as_they_are)


def _show_listings_as_they_are(
    _app: Sphinx, what: str, _name: str, _thing: object, _options: object, lines: list[str]
) -> None:
    """Indented blocks of the docstring of a module are files, commands or formulas."""
    if what != 'module':
        return
    for row in reversed(range(1, len(lines))):
        above = [line for line in lines[:row] if line][-1:]
        begins = lines[row].startswith('    ') and not lines[row - 1]
        if begins and not above[0].startswith('    ') and not above[0].endswith('::'):
            lines[row:row] = ['::', '']
