"""What the documentation points at is there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "uw_dslam_ros2" / "uw_dslam_ros2"
ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text()
ROWS = [
    line for line in ARCHITECTURE.splitlines() if re.match(r"\| [^`].*\| .*`core/.*\.py`", line)
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.split("|")[1].strip()[:40])
def test_a_row_of_the_architecture_names_files_and_what_is_in_them(row):
    names = re.findall(r"`([^`]+)`", row.split("|")[2])
    files = [name for name in names if name.endswith(".py")]
    folders = [PACKAGE / Path(file).parent for file in files if "/" in file]
    assert files
    text = ""
    for file in files:
        places = [PACKAGE / file, *(folder / file for folder in folders)]
        found = [place for place in places if place.is_file()]
        assert found, f"there is no {file}"
        text += found[0].read_text()
    for name in names:
        if not name.endswith(".py"):
            assert name.rpartition(".")[2] in text, f"{name} is not in {files}"


def test_rooms_of_the_architecture_exist():
    rooms = re.findall(r"^\| `([a-z_/]+)` \|", ARCHITECTURE, re.MULTILINE)
    assert len(rooms) > 10
    assert [room for room in rooms if not (PACKAGE / room).is_dir()] == []


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda page: page.stem)
def test_links_of_a_page_lead_somewhere(page):
    text = page.read_text()
    for name, _, anchor in re.findall(r"\]\(([^)#:\s]*)(#([^)\s]*))?\)", text):
        target = page.parent / name if name else page
        assert target.exists(), f"{page.name}: {name}"
        if anchor:
            assert anchor in _anchors(target.read_text()), f"{page.name}: #{anchor}"


def _anchors(text):
    """As GitHub makes them of headings."""
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_every_page_is_in_the_sites_navigation():
    named = re.findall(r": (\w[\w-]*\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert sorted(named) == sorted(page.name for page in (ROOT / "docs").glob("*.md"))
