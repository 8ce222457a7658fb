"""Fixtures that every test may use."""

import numpy as np
import pytest


@pytest.fixture
def rng():
    """A seeded generator, the same in every test."""
    return np.random.default_rng(2023)
