"""Two maps laid on each other: cells come where the motion says, colours say what agrees."""

from importlib import resources

import cv2
import numpy as np
import pytest

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.view.pairs import KEY, lay_on


def blocks(rng, spec):
    """Walls in blocks of 4 x 4 cells, so that a rounding of half a cell is no other map."""
    small = rng.choice([-1, 0, 100], size=(spec.num_rows // 4, spec.num_cols // 4))
    return OccupancyMap(spec, np.kron(small, np.ones((4, 4))).astype(np.int8))


@pytest.mark.parametrize("resolution_m", [0.1, 0.2])
def test_each_cell_is_what_the_source_says_there(rng, resolution_m):
    target = blocks(rng, GridSpec(0.1, 60, 80, SE2(3.0, 1.0, 0.3)))
    source = blocks(rng, GridSpec(resolution_m, 40, 40, SE2(-2.0, -1.0, -0.2)))
    motion = SE2(2.5, -1.5, 0.7)
    pair = lay_on(target, source, motion)
    cells = np.argwhere(np.ones(pair.spec.shape, bool))
    places = pair.spec.centers_of(cells)
    for laid, occupancy, points in (
        (pair.target, target, places),
        (pair.source, source, motion.inverse().apply(places)),
    ):
        own = occupancy.spec.cells_of(points)
        inside = occupancy.spec.contains(own)
        expected = np.full(len(cells), -1)
        expected[inside] = occupancy.values[own[inside, 0], own[inside, 1]]
        assert (laid.ravel() == expected).mean() > 0.999
    assert (pair.source >= 0).sum() * 0.1**2 == pytest.approx(
        source.known.sum() * resolution_m**2, rel=0.02
    )


def test_colours_tell_agreement_from_conflict():
    spec = GridSpec(0.1, 40, 40)
    target, source = np.zeros((40, 40), np.int8), np.zeros((40, 40), np.int8)
    target[10], source[11] = 100, 100  # the same quay, a cell off
    target[30] = 100  # a wall that the source saw free water at
    source[20, :20] = 100  # a wall where the target knows nothing
    target[15:25] = -1
    pair = lay_on(OccupancyMap(spec, target), OccupancyMap(spec, source), SE2())
    picture = cv2.imdecode(np.frombuffer(pair.picture("agreement"), np.uint8), -1)[::-1]
    row_0 = col_0 = (picture.shape[0] - 40) // 2
    colours = {
        name: tuple(picture[row_0 + row, col_0 + 5, 2::-1].tolist())
        for name, row in (("target", 10), ("source", 11), ("conflict", 30), ("alone", 20))
    }
    assert colours["target"] == colours["source"] == (0, 78, 56)
    assert colours["conflict"] == (204, 40, 0)
    assert colours["alone"] == (230, 159, 0)
    small = cv2.imdecode(np.frombuffer(pair.picture("agreement", 7), np.uint8), -1)
    assert max(small.shape[:2]) <= 7
    shown = {tuple(colour) for colour in small[:, :, 2::-1].reshape(-1, 3).tolist()}
    assert set(colours.values()) <= shown, "walls outlast what is smaller"


def test_the_page_explains_the_colours_as_reports_do():
    script = (resources.files("uw_dslam_ros2.view") / "static" / "pair.js").read_text()
    for name, colour in KEY.items():
        assert f'["#{bytes(colour[:3]).hex()}", "{name}"]' in script
