# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Who listens to what a node says about itself on /diagnostics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticArray
from live_robot import NODE, wait_for

from gam_relocalizer.ros.conditions import Part

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticStatus
    from live_robot import Robot

    from gam_relocalizer.ros.conditions import Condition

PARTS = [part.value for part in Part]


class Doctor:
    """Listens to what the node says about itself."""

    def __init__(self, robot: Robot) -> None:
        self.heard: list[DiagnosticArray] = []
        robot.node.create_subscription(DiagnosticArray, '/diagnostics', self.heard.append, 100)

    def report(self, part: str) -> DiagnosticStatus | None:
        """The newest one about a part."""
        name = f'{NODE.lstrip("/")}: {part}'
        newest = self.heard[-1].status if self.heard else []
        return next((status for status in newest if status.name == name), None)

    def value(self, part: str, key: str) -> str:
        """The newest value of a part."""
        report = self.report(part)
        assert report is not None
        return next(pair.value for pair in report.values if pair.key == key)

    def wait_for(self, part: str, condition: Condition, text: str = '') -> DiagnosticStatus:
        """The report of a condition, with a text in its message; it must have the right level."""

        def found() -> DiagnosticStatus | None:
            report = self.report(part)
            named = report is not None and f'{condition.name}: ' in report.message
            return report if named and text in report.message else None

        report = wait_for(found, f'{condition.name} {text}')
        assert report.level == bytes([condition.level.value])
        return report

    def levels(self) -> dict[str, bytes]:
        """The level of each part."""
        reports = {part: self.report(part) for part in PARTS}
        return {part: report.level for part, report in reports.items() if report is not None}
