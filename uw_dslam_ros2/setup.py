"""Build description of the ament_python package uw_dslam_ros2."""

import runpy
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

NAME = "uw_dslam_ros2"
# From beside this file: it is run from other folders, too.
NAMES = runpy.run_path(str(Path(__file__).resolve().parent / NAME / "node_names.py"))
COMMANDS = (
    "simulate",
    "offline",
    "doctor",
    "merge",
    "register",
    "evaluate",
    "study",
    "convert",
)

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={
        NAME: [
            "py.typed",
            "cli/reporting/templates/*",
            "view/static/*",
            "view/static/vendor/leaflet/*",
        ]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", sorted(glob("launch/*.launch.py") + glob("launch/*.yaml"))),
        (f"share/{NAME}/rviz", sorted(glob("rviz/*.rviz"))),
        (f"share/{NAME}/config", sorted(glob("config/*.yaml"))),
        (f"share/{NAME}/config/systemd", sorted(glob("config/systemd/*"))),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest", "pytest-timeout", "hypothesis"]},
    zip_safe=True,
    maintainer="uw_dslam maintainers",
    maintainer_email="maintainers@users.noreply.github.com",
    description="Distributed sonar mapping with several underwater vehicles.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            # The view of a running graph is a command that shows saved results, too.
            *(
                f"{node} = {NAME}.ros.start:{node}"
                for node in NAMES["EXECUTABLES"]
                if node != "view"
            ),
            f"view = {NAME}.cli.view:main",
            *(f"{command} = {NAME}.cli.{command}:main" for command in COMMANDS),
        ],
    },
)
