import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.sonars.imaging import SonarConfig, SonarSimulator
from uw_dslam_ros2.sim.sonars.speckle import speckle_statistics
from uw_dslam_ros2.sim.waters.clutter import Scatterers
from uw_dslam_ros2.sim.waters.world import Surface, WorldBuilder

pytestmark = pytest.mark.kernels

WALL = Surface("wall", 0.0, 4.0)


def simulator(*lines, config=SonarConfig(), surface=WALL):  # noqa: B008 - frozen
    builder = WorldBuilder()
    builder.add(surface, [[-100.0, -100.0], [100.0, -100.0]])
    for line in lines:
        builder.add(surface, line)
    return SonarSimulator(builder.build("test", 0, (0.0, 0.0), 8.0), config)


def pile(x, y, radius=0.3):
    angles = np.linspace(0.0, 2.0 * math.pi, 13)
    return np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)])


def test_a_target_to_port_is_at_a_positive_bearing(rng):
    # Heading north (yaw 90 degrees) from (10, 20); the pile, 12 m off, lies to the west: port.
    target = (10.0 - 12.0 * math.sin(math.radians(40)), 20.0 + 12.0 * math.cos(math.radians(40)))
    sonar = simulator(pile(*target))
    image = sonar.ping(0, SE2(10.0, 20.0, math.pi / 2), 3.0, rng)
    near = image.intensity[(image.range_m > 8.0) & (image.range_m < 14.0)]
    row, beam = np.unravel_index(np.argmax(near), near.shape)
    assert math.degrees(image.bearing_rad[beam]) == pytest.approx(40.0, abs=2.0)
    ranges = image.range_m[(image.range_m > 8.0) & (image.range_m < 14.0)]
    assert ranges[row] == pytest.approx(11.7, abs=0.2)


def test_a_wall_is_a_bright_arc_at_its_exact_range(rng):
    sonar = simulator([[15.0, -40.0], [15.0, 40.0]])
    image = sonar.ping(0, SE2(), 3.0, rng)
    for bearing in np.radians([-40.0, -10.0, 0.0, 25.0]):
        beam = np.argmin(np.abs(image.bearing_rad - bearing))
        expected = 15.0 / math.cos(image.bearing_rad[beam])
        around = image.intensity[:, beam - 3 : beam + 4].astype(float).mean(axis=1)
        is_wall = np.abs(image.range_m - expected) < 0.4
        is_water = (image.range_m > 5.0) & (image.range_m < expected - 2.0)
        assert around[is_wall].max() > 2.0 * around[is_water].mean()


def test_walls_seen_at_a_slant_answer_less():
    config = SonarConfig(
        seabed_db=-80.0, reverberation_db=-90.0, ring_db=-90.0, noise_db=-80.0, ghost_db=-90.0
    )
    rng = np.random.default_rng(0)

    def brightness(slope_deg):
        c, s = math.cos(math.radians(slope_deg)), math.sin(math.radians(slope_deg))
        wall = np.array([[15.0, 0.0]]) + np.array([[-s], [s]]) * 6.0 * [[1.0, -c / s]]
        sonar = simulator(wall, config=config)
        image = sonar.ping(0, SE2(), 3.0, rng)
        middle = image.intensity[:, 120:136].astype(float)
        return (middle**4).max(axis=0).mean()

    strengths = [brightness(angle) for angle in (1.0, 25.0, 50.0, 75.0)]
    assert strengths == sorted(strengths, reverse=True)


def test_behind_a_pile_there_is_a_shadow(rng):
    sonar = simulator(pile(12.0, 0.0, 0.8))
    images = [sonar.ping(0, SE2(), 3.0, rng).intensity.astype(float) for _ in range(5)]
    mean = np.mean(images, axis=0)
    rows = (sonar.range_m > 18.0) & (sonar.range_m < 24.0)
    middle = np.abs(sonar.bearing_rad) < math.radians(1.5)
    beside = (np.abs(sonar.bearing_rad) > math.radians(8)) & (
        np.abs(sonar.bearing_rad) < math.radians(12)
    )
    assert mean[rows][:, middle].mean() < 0.7 * mean[rows][:, beside].mean()


def test_strong_echoes_have_side_lobes_at_their_range(rng):
    config = SonarConfig(seabed_db=-80.0, reverberation_db=-90.0, ring_db=-90.0, noise_db=-80.0)
    target = [[9.9, -1.0], [9.9, 1.0]]
    images = [
        simulator(target, config=replace(config, side_lobe_db=db, far_lobe_db=db - 22.0))
        .ping(0, SE2(), 3.0, rng)
        .intensity.astype(float)
        for db in (-26.0, -60.0)
    ]
    row = int(9.95 / 0.1)
    flank = slice(60, 90)  # about 20 to 35 degrees off
    assert images[0][row, flank].mean() > 1.5 * images[1][row, flank].mean()
    assert images[0][row, flank].mean() > 1.2 * images[0][row - 20, flank].mean()


def test_the_surface_makes_a_ghost_behind_a_wall():
    # Down 3 m and 10 m away: by way of the surface once, half of 10 m + hypot(10 m, 6 m).
    quiet = SonarConfig(
        seabed_db=-80.0,
        reverberation_db=-90.0,
        ring_db=-90.0,
        noise_db=-80.0,
        double_bounce_db=-90.0,
    )
    wall = [[10.0, -30.0], [10.0, 30.0]]
    rng = np.random.default_rng(1)
    powers = []
    for ghost_db in (-12.0, -90.0):
        sonar = simulator(wall, config=replace(quiet, ghost_db=ghost_db))
        pings = [sonar.ping(0, SE2(), 3.0, rng).intensity.astype(float) for _ in range(30)]
        powers.append(np.mean([p[:, 124:132] ** 4 for p in pings], axis=(0, 2)))
    row = np.argmin(np.abs(sonar.range_m - 0.5 * (10.0 + math.hypot(10.0, 6.0))))
    assert powers[0][row - 1 : row + 2].max() > 100.0 * powers[1][row - 1 : row + 2].max()


def test_a_wrong_speed_of_sound_scales_the_ranges(rng):
    wall = [[15.0, -40.0], [15.0, 40.0]]
    builder = WorldBuilder()
    builder.add(WALL, wall)
    world = builder.build("test", 0, (0.0, 0.0), 8.0)
    for scale in (1.0, 1.1):
        image = SonarSimulator(world, range_scale=scale).ping(0, SE2(), 3.0, rng)
        column = image.intensity[:, 124:132].astype(float).mean(axis=1)
        assert image.range_m[np.argmax(column)] == pytest.approx(15.0 * scale, abs=0.3)


def test_fish_are_seen_where_they_are_unless_a_wall_hides_them():
    config = SonarConfig(seabed_db=-80.0, reverberation_db=-90.0, ring_db=-90.0, ghost_db=-90.0)
    fish = Scatterers(np.array([[8.0, 6.0], [20.0, -2.0]]), np.array([1.0, 1.0]))
    rng = np.random.default_rng(2)

    def power_at(sonar, x, y):
        pings = [sonar.ping(0, SE2(), 3.0, rng, fish).intensity for _ in range(20)]
        mean = np.mean([p.astype(float) ** 4 for p in pings], axis=0)
        row = np.argmin(np.abs(sonar.range_m - math.hypot(x, y)))
        beam = np.argmin(np.abs(sonar.bearing_rad - math.atan2(y, x)))
        return mean[row - 2 : row + 3, beam - 2 : beam + 3].max()

    open_water = simulator(config=config)
    behind_wall = simulator([[15.0, -9.0], [15.0, 9.0]], config=config)
    for sonar in (open_water, behind_wall):
        # To port (y > 0) and in front of the wall; the mirrored place stays dark.
        assert power_at(sonar, 8.0, 6.0) > 10_000.0 * power_at(sonar, 8.0, -6.0)
    assert power_at(open_water, 20.0, -2.0) > 3_000.0 * power_at(behind_wall, 20.0, -2.0)


def test_the_water_and_the_surface_answer_too(rng):
    # Rings lie at 3 m (the surface) and 5 m (the seabed below).
    quiet = SonarConfig(seabed_db=-80.0, reverberation_db=-90.0, ring_db=-90.0)
    ringing = replace(quiet, ring_db=-25.0)
    hazy = replace(quiet, reverberation_db=-30.0)
    dark, rings, haze = (
        simulator(config=c).ping(0, SE2(), 3.0, rng).intensity.astype(float).mean(axis=1)
        for c in (quiet, ringing, hazy)
    )
    assert rings[30] > 2.0 * dark[30]
    assert rings[50] > 2.0 * dark[50]
    assert rings[40] < 0.6 * rings[30]
    assert haze[20] > haze[60] > haze[120] > 1.1 * dark[120]


def test_gain_lifts_the_noise_with_range(rng):
    sonar = simulator(config=SonarConfig(seabed_db=-80.0, reverberation_db=-90.0, ring_db=-90.0))
    image = sonar.ping(0, SE2(0.0, 0.0, math.pi / 2), 3.0, rng).intensity.astype(float)
    bands = [image[a:b].mean() for a, b in ((20, 60), (200, 240), (300, 340), (360, 399))]
    assert bands == sorted(bands)
    assert bands[-1] > 3.0 * bands[0]


def test_a_ping_depends_on_its_generator_alone():
    sonar = simulator([[15.0, -40.0], [15.0, 40.0]])
    first = sonar.ping(0, SE2(), 3.0, np.random.default_rng(5)).intensity
    sonar.ping(0, SE2(1.0, 0.0, 1.0), 3.0, np.random.default_rng(6))
    again = sonar.ping(0, SE2(), 3.0, np.random.default_rng(5)).intensity
    other = sonar.ping(0, SE2(), 3.0, np.random.default_rng(7)).intensity
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.5


def test_speckle_is_fully_developed():
    # Pixels are the fourth root of an exponential power: Weibull of shape 4, whose coefficient of
    # variation is sqrt(Gamma(1.5) / Gamma(1.25)^2 - 1) = 0.2805 and whose skewness is -0.087.
    config = SonarConfig(
        seabed_db=-80.0, reverberation_db=-90.0, ring_db=-90.0, noise_db=0.0, saturation_db=20.0
    )
    sonar = simulator(config=config)
    rng = np.random.default_rng(0)
    pixels = np.concatenate(
        [sonar.ping(0, SE2(yaw=1.5), 3.0, rng).intensity[380:384] for _ in range(50)]
    ).astype(float)
    deviation = pixels / pixels.mean() - 1.0
    assert deviation.std() == pytest.approx(0.2805, abs=0.01)
    assert (deviation**3).mean() / deviation.std() ** 3 == pytest.approx(-0.087, abs=0.1)


@pytest.mark.data
@pytest.mark.skipif(
    not os.environ.get("UW_DATA_DIR"), reason="UW_DATA_DIR is not set: no real Oculus pings"
)
def test_speckle_is_that_of_a_real_sonar():
    data = np.load(Path(os.environ["UW_DATA_DIR"]) / "oculus" / "pings.npz")
    # The far half shows little but an even seabed.
    real = speckle_statistics(data["image"][:, 520:700, 20:236])
    config = SonarConfig(
        fov_rad=math.radians(60.0),
        num_beams=256,
        num_ranges=703,
        max_range_m=2.0,
        beam_width_rad=math.radians(0.36),
        pulse_length_m=0.003,
        seabed_db=-80.0,
        reverberation_db=-90.0,
        ring_db=-90.0,
        noise_db=-20.0,
    )
    sonar = simulator(config=config)
    rng = np.random.default_rng(0)
    pings = [sonar.ping(0, SE2(yaw=1.5), 1.0, rng).intensity[520:700, 20:236] for _ in range(3)]
    ours = speckle_statistics(np.array(pings))
    assert (np.abs(ours - real) < [0.03, 0.25, 0.12, 0.1]).all(), (ours, real)
