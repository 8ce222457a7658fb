"""The settings files that come with the project serve the commands as they serve the nodes."""

from __future__ import annotations

from pathlib import Path

import pytest

from uw_dslam_ros2.cli.running.mapping import OfflineConfig

CONFIG = Path(__file__).resolve().parents[3] / "config"


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*.yaml")), ids=lambda path: path.name)
def test_every_settings_file_is_read(path: Path) -> None:
    config = OfflineConfig.read(path, ["auv_1", "auv_2"])
    assert set(config.mapper) == {"auv_1", "auv_2"}


def test_the_dataset_has_settings_of_its_own() -> None:
    config = OfflineConfig.read(CONFIG / "aracati2017.yaml", ["auv_1"])
    assert config.mapper["auv_1"] != OfflineConfig.read(None, ["auv_1"]).mapper["auv_1"]
