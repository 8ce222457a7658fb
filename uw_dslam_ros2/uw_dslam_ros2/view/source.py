"""What a view shows, wherever it comes from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from uw_dslam_ros2.core.merging import Decision
from uw_dslam_ros2.view.showing import Showing

__all__ = ["Source"]


class Source(Protocol):
    """Where what is shown comes from: a session on disk, or a running graph."""

    @property
    def title(self) -> str:
        """What it is, for the page's head."""

    def showing(self) -> Showing:
        """The newest state."""

    def status(self) -> dict[str, Any]:
        """What changes without the map changing: ages, diagnostics, bytes on the link."""

    def decide(self, decision: Decision) -> Decision:
        """Write down what a person decided; its number and time are given here.

        Raises an error that says why it cannot be.
        """

    def listen(self, on_change: Callable[[], None]) -> None:
        """Have something called, in any thread, whenever what is shown has changed."""
