"""Acceptance as a table: what is asked in order, what follows, and the sentence that says so."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

__all__ = ["Rule", "at_least", "at_most", "first_that_applies"]


@dataclass(frozen=True, slots=True)
class Rule[CaseT, OutcomeT]:
    """One line of a table.

    ``sentence`` is for a person and holds the numbers that ``applies`` has compared;
    ``most_probability`` is left to what the line decides about.
    """

    applies: Callable[[CaseT], bool]
    outcome: OutcomeT
    sentence: Callable[[CaseT], str]
    most_probability: float = 1.0


def first_that_applies[CaseT, OutcomeT](
    rules: Sequence[Rule[CaseT, OutcomeT]], case: CaseT
) -> Rule[CaseT, OutcomeT]:
    """The first line of a table that applies; its last one has to, whatever the case."""
    return next(rule for rule in rules if rule.applies(case))


def at_most(value: float, limit: float, form: str = ".0%") -> str:
    """A value above its limit, and the limit."""
    return "{}, expected at most {}".format(*_told_apart(value, limit, form))


def at_least(value: float, limit: float, form: str = ".0%") -> str:
    """A value below its limit, and the limit."""
    return "{}, expected at least {}".format(*_told_apart(value, limit, form))


def _told_apart(value: float, limit: float, form: str) -> tuple[str, str]:
    """Two unequal numbers in a form like ".2f", with more digits where they would look equal."""
    for digits in range(int(form[1]), 20):
        texts = f"{value:.{digits}{form[2]}}", f"{limit:.{digits}{form[2]}}"
        if texts[0] != texts[1]:
            return texts
    return repr(value), repr(limit)
