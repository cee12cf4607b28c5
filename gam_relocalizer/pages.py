# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Self-contained HTML pages: nothing to load, nothing to run, readable on a phone and on paper.

A page is a title and a sequence of parts; the functions here make the parts. All text is escaped.
"""

from __future__ import annotations

import base64
import re
from html import escape
from typing import TYPE_CHECKING

from gam_relocalizer.plots import png

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from matplotlib.figure import Figure

# Pictures are drawn on white, in the dark too: they stand on a white card.
_STYLE = """
:root { color-scheme: light dark; --text: #1c2530; --paper: #ffffff; --soft: #55606e;
        --tile: #eef2f7; --line: #d5dce4; --marked: #fde8e8; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e4e8ee; --paper: #14181d; --soft: #a5afbb; --tile: #232a33; --line: #39424e;
          --marked: #4a2427; }
}
* { box-sizing: border-box; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 71rem; margin: 0 auto;
       padding: 1rem; color: var(--text); background: var(--paper); overflow-wrap: anywhere; }
h1 { font-size: 1.5rem; line-height: 1.25; margin: 0.5rem 0 1rem; }
h2 { font-size: 1.2rem; line-height: 1.3; margin: 2.2rem 0 0.6rem; }
p { margin: 0.6rem 0; max-width: 46rem; }
figure { display: inline-block; vertical-align: top; width: 33rem; max-width: 100%;
         margin: 0.8rem 1rem 1.4rem 0; break-inside: avoid; }
figure.large { display: block; width: auto; }
img { display: block; max-width: 100%; height: auto; background: #ffffff; border-radius: 0.3rem; }
figcaption { color: var(--soft); font-size: 0.9375rem; margin-top: 0.4rem; max-width: 46rem; }
.numbers { display: grid; grid-template-columns: repeat(auto-fill, minmax(9.5rem, 1fr));
           gap: 0.6rem; margin: 1rem 0; padding: 0; list-style: none; }
.numbers li { background: var(--tile); border-radius: 0.5rem; padding: 0.5rem 0.8rem;
              break-inside: avoid; }
.numbers b { display: block; font-size: 1.2rem; line-height: 1.3; }
.wide { overflow-x: auto; margin: 0.8rem 0 1.4rem; }
table { border-collapse: collapse; font-size: 0.9375rem; white-space: nowrap;
        font-variant-numeric: tabular-nums; }
th, td { padding: 0.3rem 0.8rem 0.3rem 0; text-align: left; vertical-align: top;
         border-bottom: 1px solid var(--line); }
th { color: var(--soft); font-weight: 600; }
.number { text-align: right; }
.long { white-space: normal; min-width: 18rem; }
tr.marked td { background: var(--marked); }
@media print {
  :root { color-scheme: light; --text: #000000; --paper: #ffffff; --soft: #333333;
          --tile: #ffffff; --line: #999999; --marked: #fde8e8; }
  body { max-width: none; padding: 0; font-size: 10pt; }
  .wide { overflow: visible; } table { font-size: 8pt; } td, th { white-space: normal; }
  h2 { break-after: avoid; } tr { break-inside: avoid; }
}
"""

# The page itself says that it loads nothing: a browser holds it to that.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"

# Pixels of a screen per inch of a figure, so that the text in figures is as large as around them.
_PIXELS_PER_INCH = 110
# Figures up to this width stand side by side where there is room.
_COLUMN_PIXELS = 640
# A column is one of numbers when all its cells begin like one.
_NUMBER = re.compile(r'[-+]?[\d.∞]|-$')
# Beyond so many characters a cell may break into lines.
_LONG = 40
_BOLD = re.compile(r'\*\*(.+)\*\*', re.DOTALL)
# What no HTML page can hold: control characters but white space, and halves of characters, as in
# the names of files that are not UTF-8.
_NO_TEXT = re.compile(r'[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]')


def page(title: str, parts: Iterable[str]) -> str:
    """A whole page.

    Args:
        title: Its heading.
        parts: HTML, as the other functions here make it.
    """
    return '\n'.join(
        [
            '<!DOCTYPE html>',
            '<html lang="en">',
            '<head>',
            '<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            f'<title>{_text(title)}</title>',
            f'<style>{_STYLE}</style>',
            '</head>',
            '<body>',
            f'<h1>{_text(title)}</h1>',
            *parts,
            '</body>',
            '</html>',
            '',
        ]
    )


def heading(text: str) -> str:
    """What the parts after it are about."""
    return f'<h2>{_text(text)}</h2>'


def paragraph(text: str) -> str:
    """Running text."""
    return f'<p>{_text(text)}</p>'


def numbers(values: Mapping[str, str]) -> str:
    """The numbers that sum a page up, large, by name."""
    tiles = (f'<li><b>{_text(value)}</b>{_text(name)}</li>' for name, value in values.items())
    return f'<ul class="numbers">{"".join(tiles)}</ul>'


def picture(figure: Figure, caption: str) -> str:
    """A figure and what it shows, which is also read out to those who cannot see it."""
    data, text = base64.b64encode(png(figure)).decode('ascii'), _text(caption)
    width, height = (round(_PIXELS_PER_INCH * inches) for inches in figure.get_size_inches())
    kind = _of_class('large' if width > _COLUMN_PIXELS else '')
    return (
        f'<figure{kind}><img alt="{text}" width="{width}" height="{height}" '
        f'src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'
    )


def table(
    header: Sequence[str], rows: Sequence[Sequence[str]], marked: Collection[int] = ()
) -> str:
    """A table; one that is wider than the screen scrolls sideways, and the page does not.

    A cell `**text**` is bold, as in Markdown. Columns of numbers are set to the right.

    Args:
        header: Names of the columns.
        rows: Cells by row.
        marked: Indices of the rows to point out, such as refused attempts.
    """
    kinds = [_kind([row[column] for row in rows]) for column in range(len(header))]
    return '\n'.join(
        [
            '<div class="wide"><table>',
            f'<thead>{_row("th", kinds, header)}</thead>',
            '<tbody>',
            *(_row('td', kinds, row, marked=at in marked) for at, row in enumerate(rows)),
            '</tbody>',
            '</table></div>',
        ]
    )


def markdown(text: str) -> list[str]:
    """Headings `##`, tables and paragraphs, as the evaluations print them, as parts of a page."""
    return [_block(block) for block in text.strip().split('\n\n') if block]


def _block(text: str) -> str:
    if text.startswith('## '):
        return heading(text.removeprefix('## '))
    if text.startswith('|'):
        header, _, *rows = (
            [cell.strip() for cell in line.strip('|').split('|')] for line in text.split('\n')
        )
        return table(header, rows)
    return paragraph(text)


def _row(tag: str, kinds: Sequence[str], cells: Sequence[str], *, marked: bool = False) -> str:
    return f'<tr{_of_class("marked" if marked else "")}>{"".join(_cells(tag, kinds, cells))}</tr>'


def _cells(tag: str, kinds: Sequence[str], cells: Sequence[str]) -> Iterator[str]:
    for kind, cell in zip(kinds, cells, strict=True):
        bold = _BOLD.fullmatch(cell)
        text = f'<b>{_text(bold[1])}</b>' if bold else _text(cell)
        yield f'<{tag}{_of_class(kind)}>{text}</{tag}>'


def _kind(cells: Sequence[str]) -> str:
    """Class of a column's cells."""
    filled = [cell.removeprefix('**') for cell in cells if cell]
    if filled and all(map(_NUMBER.match, filled)):
        return 'number'
    return 'long' if any(len(cell) > _LONG for cell in filled) else ''


def _of_class(name: str) -> str:
    return f' class="{name}"' if name else ''


def _text(text: str) -> str:
    """Text as HTML; what HTML cannot hold becomes the replacement character."""
    # a parser takes a carriage return for a line feed, unless it is written as a reference
    return escape(_NO_TEXT.sub('\ufffd', text)).replace('\r', '&#13;')
