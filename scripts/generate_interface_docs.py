# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Writes the tables of docs/ros_interface.md, and config/params.yaml, from the code.

    python scripts/generate_interface_docs.py            # writes what differs
    python scripts/generate_interface_docs.py --check    # only says what differs, and fails then

A table of the page stands between `<!-- begin generated: NAME -->` and `<!-- end generated -->`;
everything else there is written by hand.
"""

from __future__ import annotations

import re
import sys
import textwrap
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

import yaml
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from gam_relocalizer.localization.result import Status
from gam_relocalizer.ros.conditions import Condition, Part, diagnose
from gam_relocalizer.ros.health import Health
from gam_relocalizer.ros.interface import Service, Topic
from gam_relocalizer.ros.parameters import SPECIFICATIONS, NodeParameters

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rclpy.qos import QoSProfile

    from gam_relocalizer.ros.parameters import Specification

REPOSITORY = Path(__file__).parents[1]
PAGE = REPOSITORY / 'docs' / 'ros_interface.md'
PARAMETERS = REPOSITORY / 'config' / 'params.yaml'
INTERFACES = REPOSITORY / 'gam_relocalizer_msgs'
GENERATED = re.compile(
    r'(?<=<!-- begin generated: )([\w/.]+)( -->\n).*?(?=<!-- end generated -->)', re.DOTALL
)
ROS_TYPES = {str: 'string', bool: 'bool', int: 'integer', float: 'double'}
WIDTH = 100
PARAMETERS_HEAD = """\
# All parameters of the node, with their defaults:
#   ros2 run gam_relocalizer node --ros-args --params-file params.yaml -p map:=/path/to/map
# Numbers with a decimal point must keep it: ROS tells 2 and 2.0 apart.
#
# "Fixed": read while the node configures. All others may change while it runs.
# Written by scripts/generate_interface_docs.py from gam_relocalizer/ros/parameters.py.
/**:
  ros__parameters:
"""


def main() -> int:
    """Writes or checks both files; the exit code."""
    new = {PAGE: page(PAGE.read_text(encoding='utf-8')), PARAMETERS: parameter_file()}
    differing = [path for path, text in new.items() if path.read_text(encoding='utf-8') != text]
    check = sys.argv[1:] == ['--check']
    for path in differing:
        if not check:
            path.write_text(new[path], encoding='utf-8')
        what = 'differs from the code; run this without --check' if check else 'written'
        print(f'{path.relative_to(REPOSITORY)}: {what}')
    return int(check and bool(differing))


def page(text: str) -> str:
    """The page with every table as the code has it now.

    Raises:
        ValueError: The place of a table is not marked.
    """
    files = {str(path.relative_to(INTERFACES)) for path in INTERFACES.glob('[ms][sr][gv]/*.*')}
    missing = files.union(TABLES).difference(found[1] for found in GENERATED.finditer(text))
    if missing:
        msg = f'{PAGE}: no place is marked for {", ".join(sorted(missing))}'
        raise ValueError(msg)
    return GENERATED.sub(lambda found: f'{found[1]}{found[2]}\n{content(found[1])}\n', text)


def content(name: str) -> str:
    """What belongs between the markers of that name."""
    if '/' in name:
        return interface(INTERFACES / name)
    return TABLES[name]()


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ['---'] * len(header), *rows]
    return ''.join(
        f'|{"|".join(f" {cell} " if cell else " " for cell in line)}|\n' for line in lines
    )


def topics() -> str:
    """What the node hears, then what it says."""
    return table(
        ('direction', 'name', 'type', 'quality of service', 'what'),
        (
            (
                'in' if topic.is_input else 'out',
                f'`{topic.topic}`',
                topic.type,
                quality(topic.qos),
                topic.description,
            )
            for topic in Topic
        ),
    )


def quality(qos: QoSProfile) -> str:
    """A quality of service in words; volatile goes without saying."""
    words = ['reliable' if qos.reliability == ReliabilityPolicy.RELIABLE else 'best effort']
    if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL:
        words.append('transient local')
    return ', '.join([*words, f'depth {qos.depth}'])


def services() -> str:
    """What the node can be asked for."""
    return table(
        ('name', 'type', 'what it does'),
        ((f'`{one.service}`', one.type, one.description) for one in Service),
    )


def parameters() -> str:
    """All parameters."""
    rows = [
        (
            f'`{entry.name}`',
            ROS_TYPES[type(entry.default)],
            f'`{scalar(entry.default)}`',
            values_of(SPECIFICATIONS[entry.name]),
            SPECIFICATIONS[entry.name].unit,
            change_of(SPECIFICATIONS[entry.name]),
            SPECIFICATIONS[entry.name].description,
        )
        for entry in fields(NodeParameters)
    ]
    return table(('parameter', 'type', 'default', 'values', 'unit', 'change', 'what'), rows)


def values_of(specification: Specification) -> str:
    """What a parameter may be; empty for anything of its type."""
    if specification.bounds is not None:
        low, high = specification.bounds
        return f'{low:g} to {high:g}'
    return ', '.join(specification.choices)


def change_of(specification: Specification) -> str:
    """When a parameter may change."""
    if specification.read_only:
        return 'never'
    return 'fixed' if specification.fixed else 'any time'


def statuses() -> str:
    """The verdicts on an attempt."""
    return table(
        ('status', 'meaning', 'what to do'),
        ((f'{one.value} {one.name}', one.meaning, one.remedy) for one in Status),
    )


def conditions() -> str:
    """The conditions of the diagnostics, part by part."""

    def rows() -> Iterator[tuple[str, ...]]:
        for part in Part:
            yield f'**`{part.value}`**', '', '', ''
            for one in Condition:
                if one.part is part:
                    yield one.name, one.level.name, one.when, one.remedy

    return table(('condition', 'level', 'when', 'what it means, and what to do'), rows())


def values() -> str:
    """What the diagnostics have beside their messages."""
    return table(
        ('part', 'key', 'what'),
        (
            (f'`{one.part.value}`', f'`{value.key}`', value.meaning)
            for one in diagnose(Health())
            for value in one.values
        ),
    )


def interface(path: Path) -> str:
    """The fields of a message, or of both halves of a service, with the comments of the file."""
    halves = path.read_text(encoding='utf-8').split('\n---\n')
    names = ('request', 'answer') if len(halves) > 1 else ('',)
    head, parts = '', []
    for name, half in zip(names, halves, strict=True):
        blocks = [block.splitlines() for block in half.strip().split('\n\n')]
        if all(line.startswith('#') for line in blocks[0]):
            head = comment_of(blocks.pop(0))
        rows = [fields_of(block) for block in blocks]
        title = f'{name}: field' if name else 'field'
        parts.append(table((title, 'type', 'what'), [row for row in rows if row]))
    return '\n'.join([f'{head}\n', *parts])


def fields_of(block: Sequence[str]) -> tuple[str, str, str] | None:
    """The fields under one comment as a row; None for constants, which have their own table."""
    declared = [line.split() for line in block if not line.startswith('#')]
    if not declared or any('=' in line for line in block if not line.startswith('#')):
        return None
    kinds, names = zip(*declared, strict=True)
    return '<br>'.join(f'`{name}`' for name in names), '<br>'.join(kinds), comment_of(block)


def comment_of(block: Sequence[str]) -> str:
    """The comment of a block as one line."""
    return ' '.join(line.lstrip('# ') for line in block if line.startswith('#')).replace('  ', ' ')


def scalar(default: object) -> str:
    """A default as YAML."""
    return yaml.safe_dump(default).removesuffix('\n...\n').strip()


def parameter_file() -> str:
    """All of config/params.yaml."""
    return PARAMETERS_HEAD + ''.join(
        f'\n{comment(SPECIFICATIONS[entry.name])}\n    {entry.name}: {scalar(entry.default)}\n'
        for entry in fields(NodeParameters)
    )


def comment(specification: Specification) -> str:
    """What the file says of a parameter."""
    sentences = [specification.description]
    unit = f' {specification.unit}' if specification.unit else ''
    if specification.bounds is not None:
        sentences.append(f'From {values_of(specification)}{unit}.')
    if specification.choices:
        sentences.append(f'One of: {values_of(specification)}.')
    if specification.fixed:
        sentences.append('Fixed.')
    if specification.read_only:
        sentences.append('Read when the process starts.')
    return textwrap.fill(
        ' '.join(sentences),
        WIDTH,
        initial_indent='    # ',
        subsequent_indent='    # ',
        break_on_hyphens=False,
    )


TABLES = {one.__name__: one for one in (topics, services, parameters, statuses, conditions, values)}

if __name__ == '__main__':
    sys.exit(main())
