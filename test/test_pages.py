# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import base64
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from gam_relocalizer.pages import heading, markdown, numbers, page, paragraph, picture, table

VOID_TAGS = {'meta', 'img'}
# A page cannot hold control characters, nor what is no character.
TEXTS = st.text(
    st.characters(
        exclude_categories=['Cs', 'Cn'], exclude_characters='\x7f', min_codepoint=0x20
    ).filter(lambda one: not '\x80' <= one <= '\x9f')
    | st.sampled_from('\t\n\r<>&"\''),
    max_size=30,
)


class Page(HTMLParser):
    """The elements of a page, each with its attributes and the text in it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str], list[str]]] = []
        self.open: list[int] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or '' for name, value in attrs}, []))
        if tag not in VOID_TAGS:
            self.open.append(len(self.elements) - 1)

    def handle_endtag(self, tag: str) -> None:
        assert self.elements[self.open.pop()][0] == tag

    def handle_data(self, data: str) -> None:
        for index in self.open:
            self.elements[index][2].append(data)

    def texts(self, tag: str) -> list[str]:
        return [''.join(text) for name, _, text in self.elements if name == tag]

    def attributes(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes, _ in self.elements if name == tag]


def a_figure() -> Figure:
    figure = Figure(figsize=(2.0, 1.0))
    figure.subplots().plot([0, 1], [1, 0])
    return figure


PICTURE = picture(a_figure(), 'a <figure> & "more"')


@given(st.lists(TEXTS, min_size=6, max_size=6))
def test_any_text_comes_back_as_it_was(texts: list[str]) -> None:
    title, head, running, name, value, cell = texts
    if cell.startswith('**'):
        cell = f'_{cell}'
    parts = [heading(head), paragraph(running), numbers({name: value}), table([head], [[cell]])]
    read = Page(page(title, parts))
    assert read.open == []
    assert read.texts('h1') == read.texts('title') == [title]
    assert read.texts('h2') == read.texts('th') == [head]
    assert read.texts('p') == [running]
    assert read.texts('li') == [value + name]
    assert read.texts('td') == [cell]


@given(st.text(max_size=20))
def test_text_that_is_no_text_is_still_a_page(text: str) -> None:
    written = page(text, [paragraph(text), table([text], [[text]], marked=[0])])
    assert Page(written.encode('utf-8').decode('utf-8')).open == []
    assert '\x00' not in written


def test_a_picture_is_in_the_page_and_described() -> None:
    (image,) = Page(PICTURE).attributes('img')
    assert image['alt'] == 'a <figure> & "more"'
    assert Page(PICTURE).texts('figcaption') == [image['alt']]
    kind, data = image['src'].split(',')
    assert kind == 'data:image/png;base64'
    pixels = cv2.imdecode(
        np.frombuffer(base64.b64decode(data, validate=True), np.uint8), cv2.IMREAD_COLOR
    )
    assert pixels.std() > 1.0
    height, width = pixels.shape[:2]
    assert int(image['width']) / int(image['height']) == pytest.approx(width / height, rel=0.02)


def test_nothing_is_loaded_and_nothing_runs() -> None:
    parts = [PICTURE, heading('javascript:'), numbers({'a': 'b'}), table(['a'], [['http://b.c']])]
    read = Page(page('t', parts))
    for tag, attributes, _ in read.elements:
        assert tag not in {'script', 'link', 'iframe', 'object', 'embed', 'form', 'base'}
        for name, value in attributes.items():
            assert not name.startswith('on')
            assert name not in {'src', 'href', 'srcset'} or value.startswith('data:')
    (style,) = read.texts('style')
    assert 'url(' not in style
    assert '@import' not in style


def test_columns_of_numbers_are_told_from_columns_of_words() -> None:
    rows = [['gam', '12.5', '**3/4**', ''], ['nn-ratio', '-', '4/4', '∞'], ['3d', '-1 cm', '', '2']]
    read = Page(table(['name', 'a', 'b', 'c'], rows))
    kinds = [cell.get('class') for cell in read.attributes('td')]
    assert kinds == 3 * [None, 'number', 'number', 'number']
    assert read.texts('b') == ['3/4']


def test_rows_are_marked_by_their_index() -> None:
    read = Page(table(['a'], [['x'], ['y'], ['z']], marked=[1]))
    assert [row.get('class') for row in read.attributes('tr')] == [None, None, 'marked', None]


def test_long_cells_may_break_into_lines() -> None:
    read = Page(table(['why', 'name'], [[50 * 'a ', 'b']]))
    assert [cell.get('class') for cell in read.attributes('td')] == ['long', None]


def test_what_an_evaluation_prints_becomes_a_page() -> None:
    printed = '## Title\n\nMap <one>:\n\n| Name | [%] |\n|---|---:|\n| a | **1.0** |\n| b | |\n'
    read = Page(page('t', markdown(printed)))
    assert read.texts('h2') == ['Title']
    assert read.texts('p') == ['Map <one>:']
    assert read.texts('th') == ['Name', '[%]']
    assert read.texts('td') == ['a', '1.0', 'b', '']
    assert read.texts('b') == ['1.0']
