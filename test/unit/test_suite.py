"""Tests about tests: no comparison that can hardly fail."""

import ast
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
ORDERS = (ast.Lt, ast.LtE, ast.Gt, ast.GtE)


def ordered_tuples(text):
    """Lines on which a tuple is less or more than something."""
    return [
        node.lineno
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Compare)
        and any(isinstance(side, ast.Tuple) for side in (node.left, *node.comparators))
        and any(isinstance(op, ORDERS) for op in node.ops)
    ]


def test_no_tuple_is_bounded_by_a_tuple():
    """``(0.0, 3.0) < (0.1, 0.1)`` is true: the first numbers that differ decide."""
    assert ordered_tuples("assert a.distance_to(b) < (0.1, 0.1)\nassert (1, 2) == c") == [1]
    found = {file.name: ordered_tuples(file.read_text()) for file in TESTS.rglob("*.py")}
    assert {name: lines for name, lines in found.items() if lines} == {}
